"""The leaderboard over HTTP: the application, its pages and its client."""
