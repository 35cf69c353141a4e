"""The online track of seasons: journals, the stepping of hidden tasks, tickets, their scores."""

from leaderboard.sealed.attendant import attending
from leaderboard.sealed.tickets import Tickets

__all__ = ["Tickets", "attending"]
