"""The diagnosis of one run: where its regret is, what the evidence says about why, who in a team is
to blame, and what a life in a stream forgot, never learnt or lost."""

from __future__ import annotations

from collections.abc import Callable

from sme_registry.diagnosis.critics import critic
from sme_registry.diagnosis.document import Diagnosis
from sme_registry.diagnosis.stream import diagnose_stream
from sme_registry.diagnosis.subject import (
    AnySubject,
    StreamSubject,
    Subject,
    load_policy,
    load_run,
)
from sme_registry.diagnosis.task import diagnose_task, diagnose_team
from sme_registry.errors import OptionError
from sme_registry.io import integer_in

__all__ = [
    "Diagnosis",
    "StreamSubject",
    "Subject",
    "critic",
    "diagnose",
    "load_policy",
    "load_run",
]


def diagnose(
    subject: AnySubject,
    *,
    against: AnySubject | None = None,
    probe_capacity: bool = False,
    states: int = 8192,
    episodes: int = 64,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Measure a policy and the references, and answer every question about its regret.

    Of a team, every agent is measured over its own action channels; of a life in a stream, the
    networks at the ends of the visits.

    `against` is another run of a single agent, such as with a single axis changed, measured in the
    same way. `probe_capacity` fits a network of the same layers to a*, in tens of seconds. `states`
    are uniform, in [64, 1,000,000], and `episodes` in [8, 10,000], of a life none; fewer if a state
    is large.

    Examples:
      >>> from sme_registry.diagnosis import diagnose, load_policy
      >>> subject = load_policy("constant", "Default")
      >>> diagnosis = diagnose(subject, states=64, episodes=8)
      >>> diagnosis.level
      'no_better_than_constant'
    """
    for run in (subject, against or subject):
        if not isinstance(run, AnySubject):
            raise OptionError(f"{run!r:.60}: is no run. Give one of `load_run` or `load_policy`.")
    states = integer_in("states", states, 64, 1_000_000)
    episodes = integer_in("episodes", episodes, 8, 10_000)
    seed = integer_in("seed", seed, 0, 2**53 - 1)
    report = progress or (lambda description: None)
    if isinstance(subject, Subject) and subject.spec.team is None:
        if against is None or (isinstance(against, Subject) and against.spec.team is None):
            return diagnose_task(
                subject, states, episodes, seed, report, against, probe_capacity=probe_capacity
            )
    elif against is None and not probe_capacity:
        if isinstance(subject, StreamSubject):
            return diagnose_stream(subject, states, seed, report)
        return diagnose_team(subject, states, episodes, seed, report)
    raise OptionError(
        "against, probe_capacity: compare runs and fit networks of single agents on one task only. "
        "Leave them out for a team or a life in a stream."
    )
