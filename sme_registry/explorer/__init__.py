"""The explorer: one HTML file in which a reader sees a policy's regret in any state."""

from sme_registry.explorer.page import (
    EPISODES,
    FILE,
    STATIC,
    check_size,
    explorer_page,
    facts,
    run_report,
    write_explorer,
)
from sme_registry.explorer.policies import GraphNode, program_of_graph
from sme_registry.explorer.program import NetworkProgram

__all__ = [
    "EPISODES",
    "FILE",
    "STATIC",
    "GraphNode",
    "NetworkProgram",
    "check_size",
    "explorer_page",
    "facts",
    "program_of_graph",
    "run_report",
    "write_explorer",
]
