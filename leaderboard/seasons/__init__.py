"""Seasons: tasks that nobody sees before they count, offline and online, of one board."""
