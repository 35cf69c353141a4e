"""The streams of a study: lives as data frames, tables over runs, findings, and tables as text."""
