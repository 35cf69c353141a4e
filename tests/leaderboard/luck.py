"""What a submitter would gain by trying many artefacts for the luckiest states.

    python -m tests.leaderboard.luck [draws]

One run of each class of each trained baseline in `examples/board`, scored on `draws` draws of the
states: the best of a hundred would lie 2.51 standard deviations below the mean.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from leaderboard.artefact.sandbox import Sandbox
from leaderboard.documents.submission import Submission
from leaderboard.scoring.metrics import run_metrics
from leaderboard.store import Store
from sme_registry import evaluate

BOARD = Path(__file__).resolve().parents[2] / "examples" / "board"
BEST_OF_100 = 2.51  # mean of the largest of 100 standard normal numbers


def gain(metrics: list[dict[str, float]], name: str) -> float:
    """The share of the mean that the best of a hundred lies below it."""
    values = np.array([each[name] for each in metrics])
    return BEST_OF_100 * float(values.std(ddof=1) / values.mean())


def gains(store: Store, submission: Submission, draws: int) -> dict[str, tuple[float, float]]:
    """Of a run of each class: what trying a hundred gains in N₀ and in A, as shares of them."""
    found: dict[str, tuple[float, float]] = {}
    board = store.document
    levels = tuple(high for _, high in board.protocol.edges)
    for run in submission.runs:
        name, spec = board.instances[run.spec]
        if name in found or run.artefact is None:
            continue
        data = store.objects.read(run.artefact.sha256)
        metrics = []
        with Sandbox(data, spec.state_dim + 2, spec.action_dim) as policy:
            for seed in range(draws):
                protocol = board.protocol.model_copy(update={"seed": seed})
                report = evaluate(policy, spec, protocol, action_range="unit")
                regret = [region.normalised_regret for region in report.regions]
                similarity = [region.similarity for region in report.regions]
                metrics.append(run_metrics(regret, similarity, levels))
        found[name] = (gain(metrics, "wd_regret"), gain(metrics, "ood_regret"))
    return found


def main() -> None:
    """Print the gains."""
    draws = int(sys.argv[1]) if len(sys.argv) > 1 else 24
    with Store.open(BOARD, read_only=True) as store:
        for entry in store.entries():
            submission = store.submission(entry.id).submission
            if submission.method.knowledge != "generic":
                continue
            for name, (wd, ood) in gains(store, submission, draws).items():
                print(
                    f"{submission.method.name:8} {name:16} N0 {wd:.2%}  OOD {ood:.2%}", flush=True
                )


if __name__ == "__main__":
    main()
