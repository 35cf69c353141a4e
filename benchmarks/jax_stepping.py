"""Steps of an environment with gymnax's signature inside `lax.scan`; as a script, of its Pendulum.

gymnax runs in a process of its own: `make framework-gymnax` creates its environment, and importing
`sme_registry.jax` would turn the Pendulum's numbers into float64.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

LANES, STEPS = 1024, 100


def stepping(env: Any, params: Any, actions: int) -> Callable[[int], None]:
    """Steps of all lanes with fixed actions, `STEPS` in one call; episodes begin anew at the end.

    `env` has gymnax's `reset` and `step`; `actions` is the number of action channels.
    """
    action = jnp.full((LANES, actions), 0.4, jnp.float32)

    @jax.jit
    def rollout(key: Any, state: Any) -> Any:
        def advance(carry: Any, _: None) -> Any:
            key, state, total = carry
            key, now = jax.random.split(key)
            keys = jax.random.split(now, LANES)
            _, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(keys, state, action, params)
            return (key, state, total + reward.sum()), None

        start = key, state, jnp.zeros(())
        return jax.lax.scan(advance, start, None, STEPS)[0]

    keys = jax.random.split(jax.random.key(0), LANES)
    carry = jax.random.key(1), jax.vmap(env.reset, (0, None))(keys, params)[1]

    def work(steps: int) -> None:
        nonlocal carry
        for _ in range(max(1, steps // STEPS)):
            *carry, _ = jax.block_until_ready(rollout(*carry))

    return work


if __name__ == "__main__":
    import gymnax

    pendulum, params = gymnax.make("Pendulum-v1")
    work = stepping(pendulum, params, 1)
    for line in sys.stdin:
        work(int(line))
        print(flush=True)
