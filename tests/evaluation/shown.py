"""What policies observe of a task whose agents see the state."""

from __future__ import annotations

import numpy as np

from sme_registry.evaluation import regions


def observations(protocol, region, spec, rows=None):
    """All observations of a region, `[N, S + 2]`."""
    batches = regions.states(protocol, region, spec, rows)
    return np.concatenate([batch.observation(batch.s, spec.horizon) for batch in batches])
