"""Sealed-online seasons: learn in hidden tasks that a board's server steps, and answer for them.

    import sme_registry
    from sme_registry import sealed

    env = sealed.make("https://board.example", "ticket.json", instance=0)
    ...                                               # train as in any environment of Gymnasium
    sealed.answer("https://board.example", "ticket.json", policy, instance=0)

`sealed.sb3.SealedVecEnv` is for Stable-Baselines3. `wire` says what server and client send.
"""

from sme_registry.sealed.connection import PATIENCE
from sme_registry.sealed.envs import SealedEnv, SealedVectorEnv, make, make_vec
from sme_registry.sealed.instance import (
    WITHOUT_TASK,
    Instance,
    actions_in,
    answer,
    prepare_policy,
)
from sme_registry.sealed.signing import Signer, Statement
from sme_registry.sealed.ticket import (
    InstanceStatus,
    JournalDigest,
    Place,
    Ticket,
    TicketClass,
    TicketStatus,
    instance_name,
)
from sme_registry.sealed.wire import (
    Begun,
    StepFormat,
    Steps,
    bearer,
    instance_path,
    pack_table,
    table_bytes,
    ticket_path,
    tickets_path,
    unpack_table,
)

__all__ = [
    "PATIENCE",
    "WITHOUT_TASK",
    "Begun",
    "Instance",
    "InstanceStatus",
    "JournalDigest",
    "Place",
    "SealedEnv",
    "SealedVectorEnv",
    "Signer",
    "Statement",
    "StepFormat",
    "Steps",
    "Ticket",
    "TicketClass",
    "TicketStatus",
    "actions_in",
    "answer",
    "bearer",
    "instance_name",
    "instance_path",
    "make",
    "make_vec",
    "pack_table",
    "prepare_policy",
    "table_bytes",
    "ticket_path",
    "tickets_path",
    "unpack_table",
]
