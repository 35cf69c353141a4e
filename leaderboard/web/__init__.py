"""The leaderboard over HTTP: server, pages and client."""
