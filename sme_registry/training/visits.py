"""`VisitEnds`: when a learner's policy is the one at the end of a visit of a stream's phase.

That policy has learned from all that the learner collected in the visit: with TD3 and SAC up to the
update that follows its last step, with PPO up to that of the last rollout that was over by then. So
it is the policy at the first step of the next visit, before any update that follows that step.
The last visit ends with the training, since the last phase goes on: PPO finishes its last rollout
in it. `jax.run.run` has the same rule.
"""

from __future__ import annotations

from collections.abc import Callable

from sme_registry.spec import StreamSpec


class VisitEnds:
    """Calls a function at the end of each visit, while steps are counted."""

    def __init__(
        self, stream: StreamSpec, on_visit: Callable[[int], object], steps: int = 0
    ) -> None:
        *upcoming, self._last = stream.visit_ends()
        self._upcoming = [(visit, end) for visit, end in upcoming if end >= steps]
        self._on_visit = on_visit

    def after_step(self, steps: int) -> None:
        """Count a step; `steps` are all that were taken, and the learner has not learned since."""
        while self._upcoming and self._upcoming[0][1] < steps:
            self._on_visit(self._upcoming.pop(0)[0])

    def finish(self, steps: int) -> None:
        """End the visits that are over when training ends, after its last update."""
        self.after_step(steps + 1)
        visit, end = self._last
        if end <= steps:
            self._on_visit(visit)
