"""How much a submitter would gain by trying many artefacts until the evaluation states suit one.

    python -m benchmarks.lucky_states BOARD [draws]

One run of each class of each generic method is scored on `draws` samples of the states. The best of
a hundred would lie 2.51 standard deviations below the mean.
"""

from __future__ import annotations

import sys

import numpy as np

from leaderboard.documents.submission import Submission
from leaderboard.gate.sandbox import Sandbox
from leaderboard.scoring.ranking import run_metrics
from leaderboard.store import Store
from sme_registry import evaluate

BEST_OF_100 = 2.51  # mean of the largest of 100 standard normal numbers


def gain(metrics: list[dict[str, float]], name: str) -> float:
    """How far the best of a hundred lies below the mean, as a share of the mean."""
    values = np.array([each[name] for each in metrics])
    return BEST_OF_100 * float(values.std(ddof=1) / values.mean())


def gains_of(store: Store, submission: Submission, draws: int) -> dict[str, tuple[float, float]]:
    """The gains of one run of each class in WD regret and OOD regret, as shares of each."""
    gains: dict[str, tuple[float, float]] = {}
    board = store.document
    levels = tuple(high for _, high in board.protocol.edges)
    for run in submission.runs:
        name, spec = board.instances[run.spec]
        if name in gains or run.artefact is None:
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
        gains[name] = (gain(metrics, "wd_regret"), gain(metrics, "ood_regret"))
    return gains


def main() -> None:
    """Print the gains."""
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    draws = int(sys.argv[2]) if len(sys.argv) > 2 else 24
    with Store.open(sys.argv[1], read_only=True) as store:
        for entry in store.entries():
            submission = store.submission(entry.id).submission
            if submission.method.knowledge != "generic":
                continue
            for name, (wd, ood) in gains_of(store, submission, draws).items():
                print(
                    f"{submission.method.name:8} {name:16} N0 {wd:.2%}  OOD {ood:.2%}", flush=True
                )


if __name__ == "__main__":
    main()
