"""Scores: of a run, of a submission, and the ranking of submissions."""
