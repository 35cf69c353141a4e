"""Short training runs for these tests."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sme_registry import SMESpec
from sme_registry.training import TrainingResult, train

TINY = SMESpec(state_dim=2, action_dim=2, horizon=20, seed=5)


PROTOCOL = {"states_per_region": 50}


def short(folder: Path, **changes: Any) -> TrainingResult:
    settings: dict[str, Any] = {
        "algorithm": "TD3",
        "steps": 150,
        "protocol": PROTOCOL,
        "progress": False,
    }
    return train(TINY, folder=folder, **{**settings, **changes})


def copy_files(source: Path, target: Path) -> None:
    target.mkdir()
    for path in source.iterdir():
        if path.is_file():
            (target / path.name).write_bytes(path.read_bytes())
