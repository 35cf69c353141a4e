"""When a policy is the one at the end of a visit."""

import pytest

from sme_registry import SMESpec, StreamSpec
from sme_registry.training.visits import VisitEnds

SPEC = SMESpec(state_dim=1, action_dim=1, horizon=5)
STREAM = StreamSpec(
    phases=[{"spec": SPEC, "steps": 5}, {"spec": SPEC.derive(seed=1), "steps": 5}], cycles=2
)


@pytest.mark.parametrize(
    ("first", "steps", "called"),
    [
        (0, 20, [(0, 6), (1, 11), (2, 16), (3, "end")]),
        (0, 24, [(0, 6), (1, 11), (2, 16), (3, "end")]),  # the last phase goes on
        (10, 20, [(1, 11), (2, 16), (3, "end")]),  # resumed before the policy of visit 1 was called
        (24, 24, [(3, "end")]),  # after the last step
        (0, 15, [(0, 6), (1, 11), (2, "end")]),  # cut where a visit ends
        (0, 14, [(0, 6), (1, 11)]),
    ],
)
def test_visits_end_at_the_next_step_and_the_last_one_with_the_training(first, steps, called):
    ended = []
    now = first
    visits = VisitEnds(STREAM, lambda visit: ended.append((visit, now)), first)
    for now in range(first + 1, steps + 1):
        visits.after_step(int(now))
    now = "end"
    visits.finish(steps)
    assert ended == called
