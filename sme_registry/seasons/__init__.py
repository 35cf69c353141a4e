"""Sealed-online seasons: learn in hidden tasks that a board's server steps, and answer for them.

    from sme_registry import seasons

    env = seasons.make("https://board.example", "ticket.json", instance=0)
    ...                                               # train as in any environment of Gymnasium
    seasons.answer("https://board.example", "ticket.json", policy, instance=0)

`seasons.sb3.SealedVecEnv` is for Stable-Baselines3. `wire` says what server and client send.
"""

from sme_registry.seasons.client import WITHOUT_TASK as WITHOUT_TASK
from sme_registry.seasons.client import Instance, answer, make, make_vec
from sme_registry.seasons.client import actions_in as actions_in
from sme_registry.seasons.client import prepare_policy as prepare_policy
from sme_registry.seasons.wire import Ticket

__all__ = [
    "Instance",
    "Ticket",
    "answer",
    "make",
    "make_vec",
]
