"""The online track of seasons: journals, the stepping of hidden tasks, tickets, their scores."""

from leaderboard.sealed.replay import SeasonReport, verify_season
from leaderboard.sealed.tickets import Tickets, attending

__all__ = ["SeasonReport", "Tickets", "attending", "verify_season"]
