"""`run_metrics`: the metrics of one run, from the numbers of its regions.

`documents.result` defines them. A run without a policy scores 1 in each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from leaderboard.documents.result import METRICS, RunScore
from sme_registry.spec import EvaluationProtocol


def run_metrics(
    normalised_regret: Sequence[float], similarity: Sequence[float] | None, levels: Sequence[float]
) -> dict[str, float]:
    """The metrics of one run by name, as defined in `documents.result`.

    Args:
      normalised_regret: N_m of each region, WD first.
      similarity: mean r̃ of each region, in [0, 1]; None without a policy.
      levels: ε_m, 0 for WD.

    Returns:
      `wd_regret`, `ood_regret`, `ood_decay` and `regret_slope`, dimensionless, and
      `similarity_loss`, in points (hundredths of r̃). Without a policy each is 1 (100 points), and
      not what N_m = 1 everywhere gives: a decay of 0 would reward leaving out runs.
    """
    if similarity is None:
        return {**dict.fromkeys(METRICS, 1.0), "similarity_loss": 100.0}
    N, r = np.asarray(normalised_regret), np.asarray(similarity)
    offset = np.asarray(levels) - np.mean(levels)
    wd, ood = float(N[0]), float(N[1:].mean())
    return {
        "wd_regret": wd,
        "ood_regret": ood,
        "ood_decay": ood - wd,
        "regret_slope": float(offset @ (N - wd) / (offset @ offset)),  # exactly 0 where N is flat
        "similarity_loss": 100.0 * float(r[0] - r[1:].mean()),
    }


def levels_of(protocol: EvaluationProtocol) -> tuple[float, ...]:
    """ε_m of each region's outer face; 0 for WD."""
    return tuple(high for _, high in protocol.edges)


def failed_run(protocol: EvaluationProtocol, class_name: str, spec: str | None) -> RunScore:
    """A run without a policy: 1 in every region and every metric.

    `spec` is the digest of the instance, None if the run is not listed.
    """
    regrets = (1.0,) * len(protocol.edges)
    metrics: dict[str, Any] = {**run_metrics(regrets, None, levels_of(protocol))}
    return RunScore(
        spec=spec,
        class_name=class_name,
        artefact=None,
        evaluation_seed=None,
        normalised_regret=regrets,
        similarity=None,
        **metrics,
    )
