"""Checks of a task's limits: how often the optimum breaks them, and how uniform v is.

Source: METHOD, section 8. With π*_i and v_i uniform and independent, the optimum is above its limit
ℓ_i = 1 − 2τ v_i in a share τ of states and channels. Draws come near that where the networks spread
over their range. The share over τ (smallest, mean ± SD, largest of 40 draws, 8,000 states each),
and the largest KS distance of a channel of v from uniform (median of the draws):

    S, A, L   init             τ     share / τ               KS
    8, 4,  1  either           .05    .49   .98 ± .21  1.26  .02
    8, 4,  1  either           .1     .64  1.02 ± .17  1.24  .02
    8, 4,  1  either           .2     .79  1.01 ± .11  1.19  .02
    8, 4,  1  either           .4     .90   .99 ± .04  1.06  .02
    8, 4,  3  unit_variance    .05    .39   .99 ± .36  1.71  .08
    8, 4,  3  unit_variance    .2     .74  1.01 ± .13  1.23  .08
    8, 4, 10  unit_variance    .2     .84  1.03 ± .11  1.31  .07
    8, 4,  2  semi_orthogonal  .2     .04   .25 ± .11   .51  .24
    8, 4,  3  semi_orthogonal  .2     .23   .41 ± .11   .62  .19
    8, 4,  5  semi_orthogonal  .2     .39   .72 ± .15  1.06  .12
    2, 2, 10  unit_variance    .2     .00   .98 ± .46  2.22  .19
   32, 8, 10  unit_variance    .2     .93  1.01 ± .03  1.08  .03

A draw passes where its share is within a half of τ. With few channels, π* and v of one draw are
correlated, and the share varies. `semi_orthogonal` networks of 2 to 5 layers stay near ½ where
layers widen, and seldom reach their limits: use `unit_variance` with safety. At τ = ½ the share is
½ for any networks, even constant ones, by symmetry; there the KS distance decides.
"""

from __future__ import annotations

import math

import numpy as np

from sme_registry.task.certificate import Check, judged, numbers, reported
from sme_registry.task.task import Task, through
from sme_registry.task.uniformity import distance_from_uniform

_BLOCK = 4_096  # states


def safety_checks(task: Task, seed: int, states: int) -> tuple[Check, ...]:
    """The checks of a task with `safety`; none without."""
    if task.spec.safety is None:
        return ()
    tau = task.spec.safety.tightness
    s = numbers(task, seed, "limits", states, task.spec.state_dim)
    blocks = [s[i : i + _BLOCK] for i in range(0, states, _BLOCK)]
    optimal = np.concatenate([task.policy(block) for block in blocks])
    limit = np.concatenate([task.limit(block) for block in blocks])
    v = np.concatenate([through(task.limiting, block) for block in blocks])
    broken = optimal > limit
    price = 1.0 - task.safe_reward_of(optimal, limit).mean()
    return (
        judged(
            "broken_limits",
            float(broken.mean()),
            "Share of uniform states and channels in which π* is above its limit; near the "
            f"tightness, {tau:g}, where π* and v spread over their range. Lower: the limits "
            "matter little. Higher: they bind more than the tightness says.",
            passes=(0.5 * tau, 1.5 * tau),
            warns=(0.25 * tau, 2.0 * tau),
        ),
        judged(
            "limit_uniformity",
            distance_from_uniform(v) / math.sqrt(states),
            "Largest KS distance of a channel of v, and so of a limit, from uniform over uniform "
            "states; 0.5 where the limit has collapsed to a constant.",
            passes=(0.0, 0.2),
            warns=(0.0, 0.4),
        ),
        reported(
            "states_with_a_broken_limit",
            float(broken.any(axis=1).mean()),
            "Share of uniform states in which π* is above the limit of at least one channel.",
        ),
        reported(
            "price_of_safety",
            float(price),
            "What the best safe policy forgoes of the largest step reward, on average over "
            "uniform states.",
        ),
    )
