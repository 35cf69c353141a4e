"""Writes `docs/catalogue.md` from the files under `specs/`: `make docs`."""

from __future__ import annotations

from pathlib import Path

from sme_registry.files import write_atomically
from sme_registry.spec import EnvFile, ProtocolFile, SuiteFile
from sme_registry.spec.catalogue import entries

PAGE = Path(__file__).with_name("catalogue.md")
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


def _short(digest: str) -> str:
    return digest[: len("sha256:") + 12]


if __name__ == "__main__":
    write_atomically(PAGE, catalogue())
    print(f"wrote {PAGE}")
