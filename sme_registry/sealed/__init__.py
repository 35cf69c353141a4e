"""Sealed-online seasons: hidden tasks that a board's server steps.

`wire` says what server and client send each other.
"""

from sme_registry.sealed.ticket import (
    InstanceStatus,
    Place,
    Ticket,
    TicketClass,
    TicketStatus,
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
    "Begun",
    "InstanceStatus",
    "Place",
    "StepFormat",
    "Steps",
    "Ticket",
    "TicketClass",
    "TicketStatus",
    "bearer",
    "instance_path",
    "pack_table",
    "table_bytes",
    "ticket_path",
    "tickets_path",
    "unpack_table",
]
