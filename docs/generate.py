"""Writes the pages of `docs/` that are lists of what the code and `specs/` hold: `make docs`."""

from __future__ import annotations

from pathlib import Path

from leaderboard.errors import CODES
from sme_registry.io import write_atomically
from sme_registry.spec import EnvFile, ProtocolFile, SuiteFile
from sme_registry.spec.catalogue import entries

FOLDER = Path(__file__).parent
_FIELDS = ("state_dim", "action_dim", "k", "r_min", "D", "complexity", "hidden_width")
_SYMBOLS = ("S", "A", "k", "r_min", "D", "L", "H")


def catalogue() -> str:
    """The page, from the catalogue's files."""
    lines = [
        "# The catalogue",
        "",
        "Written by `make docs` from the files under `specs/`; do not edit it here.",
        "",
        "## Environments",
        "",
        f"| Id | {' | '.join(_SYMBOLS)} | agents | digest | |",
        "|---" * (len(_SYMBOLS) + 4) + "|",
    ]
    for env in entries(EnvFile):
        values = " | ".join(f"{getattr(env.spec, field):g}" for field in _FIELDS)
        env_id, digest = f"SME/{env.versioned_name}", _short(env.digest)
        agents = len(env.spec.team.agents) if env.spec.team else 1
        lines.append(f"| `{env_id}` | {values} | {agents} | `{digest}` | {env.description} |")
    lines += ["", "## Suites", "", "| Name | classes | instances | digest | |", "|---" * 5 + "|"]
    for suite in entries(SuiteFile):
        counts = f"{len(suite.suite.classes)} | {len(suite.suite.instances)}"
        lines.append(
            f"| `{suite.versioned_name}` | {counts} | `{_short(suite.digest)}` "
            f"| {suite.description} |"
        )
    lines += ["", "## Protocols", "", "| Name | states a region | digest | |", "|---" * 4 + "|"]
    for protocol in entries(ProtocolFile):
        lines.append(
            f"| `{protocol.versioned_name}` | {protocol.protocol.states_per_region:,} "
            f"| `{_short(protocol.digest)}` | {protocol.description} |"
        )
    return "\n".join(lines) + "\n"


def leaderboard_codes() -> str:
    """The page of the codes with which a board refuses."""
    lines = [
        "# Codes",
        "",
        "Written by `make docs`. With these a board refuses: at the command line (exit code 1),",
        "over HTTP (`code`), and in a rejected result. What is released keeps its meaning.",
        "",
        "| Code | |",
        "|---|---|",
        *(f"| `{code}` | {meaning} |" for code, meaning in CODES.items()),
    ]
    return "\n".join(lines) + "\n"


def _short(digest: str) -> str:
    return digest[: len("sha256:") + 12]


PAGES = {"catalogue.md": catalogue, "leaderboard-codes.md": leaderboard_codes}

if __name__ == "__main__":
    for name, page in PAGES.items():
        print(f"wrote {write_atomically(FOLDER / name, page())}")
