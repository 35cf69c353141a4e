"""From numbers to words: each question answered by a rule whose threshold stands in `THRESHOLDS`.

"where" questions are about the policy, and its numbers answer them. "why" questions are about the
training, of which a policy shows only traces: they are answered yes or no where a number separates
the causes, and otherwise "cannot tell", with what would.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from sme_registry.diagnosis.report import (
    Answer,
    Comparison,
    Difference,
    Finding,
    Numbers,
)
from sme_registry.diagnosis.subject import Subject
from sme_registry.spec import SMESpec

THRESHOLDS = {
    "solved": 0.1,  # ν at most: nothing is left to explain
    "like_constant": 0.95,  # ν at least: no better than the constant ½
    "unlearnt": 0.9,  # ν of a channel, or of the run beside this one, at least
    "channel_learnt": 0.6,  # ν of a channel at most
    "excess_saturation": 0.2,  # share of entries at a bound beyond the optimum's
    "share_of_squared_error": 0.5,  # of one form, for it to be the form
    "share_of_noise_or_clock": 0.25,
    "explained_by_state": 0.1,  # share of the errors' variance between bins
    "bin_ratio": 1.5,  # of the worst bin's error to the best one's, for it to matter
    "learnt": 0.7,  # slope on a part of π*, at least
    "not_learnt": 0.3,  # at most
    "part_of_optimum": 0.1,  # share of π*'s variance for a part to matter
    "lost_outside": 0.1,  # of r̃, from WD to the outermost shell
    "episode_gap": 0.25,  # ratio of ν on policy and in uniform states, beyond 1
    "time_gap": 0.25,  # ratio of the error late and early in episodes, beyond 1
    "hidden_by_r_min": 0.25,  # share of steps
    "paid_at_random": 0.02,  # share of steps under uniform random actions
    "ended_by_D": 0.5,  # share of episodes
    "still_gaining": 0.02,  # fall of the running median of regret over the last third
    "fell_back": 0.1,  # rise of it from its best
    "probe_far_better": 0.5,  # the probe's ν over the agent's, at most
    "probe_no_better": 0.8,  # at least
    "difference": 0.1,  # of ν between two runs
}
_T = THRESHOLDS
_NOTHING = "Nothing is left to explain: ν is {0:.2f} (at most {1:g})."


class _Case(NamedTuple):
    numbers: Numbers
    spec: SMESpec
    comparison: Comparison | None

    @property
    def solved(self) -> bool:
        return self.numbers.own.normalised <= _T["solved"]


_Said = tuple[Answer, str]


def findings(
    numbers: Numbers, spec: SMESpec, comparison: Comparison | None = None
) -> tuple[Finding, ...]:
    """Every question, answered; the comparison's fields and differences may decide some."""
    case = _Case(numbers, spec, comparison)
    found = []
    for kind, questions in (("where", _WHERE), ("why", _WHY)):
        for question, rule in questions.items():
            if kind == "why" and case.solved:
                said: _Said = "no", _NOTHING.format(numbers.own.normalised, _T["solved"])
            else:
                # The first that decides; where none does, the first, which knows the most.
                answers = [a for a in (_by_comparison(case, question), rule(case)) if a is not None]
                said = next((a for a in answers if a[0] != "cannot tell"), answers[0])
            found.append(
                Finding(question=question, kind=kind, answer=said[0], text=said[1])  # type: ignore[arg-type]
            )
    return tuple(found)


def headline(numbers: Numbers, found: tuple[Finding, ...]) -> str:
    """The verdict: how good, what stands out, and what it is put down to."""
    own, uniform = numbers.own, numbers.uniform
    half, linear = uniform["constant_half"], uniform["linear_least_squares"]
    if own.normalised <= _T["solved"]:
        verdict = "Solved"
    elif own.normalised >= _T["like_constant"]:
        verdict = "No better than a constant action"
    elif own.normalised > linear.normalised:
        verdict = "Better than a constant action, worse than the best linear policy"
    else:
        verdict = "Better than the best linear policy, not optimal"
    text = (
        f"{verdict}: mean regret {own.regret:.2f} in uniform states of the cube, ν = "
        f"{own.normalised:.2f} (constant ½: {half.regret:.2f} and 1; linear: {linear.regret:.2f} "
        f"and {linear.normalised:.2f}; optimum: 0 and 0)."
    )
    by_answer = {
        (kind, answer): [f.question for f in found if (f.kind, f.answer) == (kind, answer)]
        for kind in ("where", "why")
        for answer in ("yes", "cannot tell")
    }
    if by_answer["where", "yes"]:
        text += f" What stands out: {', '.join(by_answer['where', 'yes'])}."
    if own.normalised > _T["solved"]:
        yes, open_ = by_answer["why", "yes"], by_answer["why", "cannot tell"]
        text += f" Put down to: {', '.join(yes)}." if yes else " No cause is established."
        text += f" Cannot tell: {', '.join(open_)}." if open_ else ""
    return text


# --- where the error sits -----------------------------------------------------------------------


def _channels(case: _Case) -> _Said:
    channels = case.numbers.channels
    bad = [c for c in channels if c.normalised >= _T["unlearnt"]]
    good = [c for c in channels if c.normalised <= _T["channel_learnt"]]
    worst = max(channels, key=lambda c: c.normalised)
    best = min(channels, key=lambda c: c.normalised)
    limits = f"unlearnt from {_T['unlearnt']:g}, learnt to {_T['channel_learnt']:g}"
    if bad and good:
        names = ", ".join(f"{c.channel} (ν {c.normalised:.2f}, slope {c.slope:.2f})" for c in bad)
        share = sum(c.regret for c in bad) / max(case.numbers.own.regret, 1e-12)
        return "yes", (
            f"{len(bad)} of {len(channels)} action channels are not learnt while {len(good)} are: "
            f"{names}. They are charged {share:.0%} of the regret ({limits})."
        )
    return "no", (
        f"The error is spread over the action channels: ν from {best.normalised:.2f} (channel "
        f"{best.channel}) to {worst.normalised:.2f} (channel {worst.channel}; {limits})."
    )


def _state_region(case: _Case) -> _Said:
    partitions = case.numbers.partitions
    most = max(partitions, key=lambda p: p.explained)
    by = "the distance from the cube's centre" if most.by == 0 else f"state channel {most.by}"
    low, high = min(most.error), max(most.error)
    at = most.error.index(high)
    span = f"{most.edges[at]:.2f}–{most.edges[at + 1]:.2f}"
    centre = partitions[0].explained
    text = (
        f"{by[0].upper()}{by[1:]} explains most of where in the cube the error is: "
        f"{most.explained:.0%} of its variance (from {_T['explained_by_state']:.0%}), the bins' "
        f"error from {low:.3f} to {high:.3f} (from a ratio of {_T['bin_ratio']:g}), most at "
        f"{span}. Distance from the centre explains {centre:.0%}."
    )
    apart = high >= _T["bin_ratio"] * low
    return _yes_if(most.explained >= _T["explained_by_state"] and apart and not case.solved, text)


def _shells(case: _Case) -> _Said:
    inside, outside = case.numbers.shells[0], case.numbers.shells[-1]
    lost = outside.policies[""].error - inside.policies[""].error
    linear = outside.policies["linear_least_squares"]
    own = outside.policies[""].normalised
    text = (
        f"r̃ changes by {-lost:+.3f} from WD to {outside.name} (a loss from {_T['lost_outside']:g}),"
        f" ν from {inside.policies[''].normalised:.2f} to {own:.2f}; the linear policy's is "
        f"{linear.normalised:.2f} there."
    )
    return _yes_if(lost >= _T["lost_outside"], text)


def _time(case: _Case) -> _Said:
    episodes = case.numbers.on_policy
    first, last = episodes.error[0], episodes.error[-1]
    ratio = max(first, last) / max(min(first, last), 1e-9)
    text = (
        f"On policy the error is {first:.3f} in the first {len(episodes.error)}th of the time and "
        f"{last:.3f} in the last (a ratio from {1 + _T['time_gap']:g}, and 0.02 apart, counts)."
    )
    matters = ratio >= 1 + _T["time_gap"] and abs(first - last) >= 0.02
    return _yes_if(matters, text)


def _states_met(case: _Case) -> _Said:
    episodes, own = case.numbers.on_policy, case.numbers.own
    met = episodes.scores[""]
    ratio = met.normalised / max(own.normalised, 1e-9)
    drift = max(episodes.drift)
    text = (
        f"ν is {met.normalised:.2f} in the states that it meets and {own.normalised:.2f} in uniform"
        f" ones; state channel {episodes.drift.index(drift) + 1} is furthest from uniform on policy"
        f" (distance {drift:.2f}). A ratio beyond {1 + _T['episode_gap']:g} either way, and 0.05 "
        "apart, counts."
    )
    apart = abs(met.normalised - own.normalised) >= 0.05
    limit = 1 + _T["episode_gap"]
    if apart and ratio <= 1 / limit:
        return "yes", f"{text} It has learnt best where it goes."
    if apart and ratio >= limit:
        return "yes", f"{text} It goes where it has learnt least."
    return "no", text


def _constant_offset(case: _Case) -> _Said:
    share = case.numbers.form.offset
    worst = max(case.numbers.channels, key=lambda c: abs(c.offset))
    return _yes_if(
        share >= _T["share_of_squared_error"] and not case.solved,
        f"{share:.0%} of the squared error is a constant offset (from "
        f"{_T['share_of_squared_error']:.0%}), the largest {worst.offset:+.3f} in channel "
        f"{worst.channel}.",
    )


def _reaction(case: _Case) -> _Said:
    form, channels = case.numbers.form, case.numbers.channels
    slope = sum(c.slope for c in channels) / len(channels)
    word = "too little" if slope < 1 else "too much"
    return _yes_if(
        form.scale >= _T["share_of_squared_error"] and not case.solved,
        f"{form.scale:.0%} of the squared error comes from reacting {word} (from "
        f"{_T['share_of_squared_error']:.0%}): the slope of a on a* is {slope:.2f}, and 1 is "
        f"right. With the state, actions move {form.gain:.1f} × as far as the optimal ones.",
    )


def _beyond_linear(case: _Case) -> _Said:
    form = case.numbers.form
    text = f"{form.beyond_linear:.0%} of π*'s variance is in no affine map of the state"
    if form.beyond_linear < _T["part_of_optimum"] or form.learnt_rest is None:
        return "no", f"{text} (it matters from {_T['part_of_optimum']:.0%})."
    learnt = "" if form.learnt_linear is None else f"; of the affine part {form.learnt_linear:.2f}"
    text += (
        f"; of that part the policy has {form.learnt_rest:.2f}{learnt} (1 is all; little is "
        f"to {_T['not_learnt']:g}, most from {_T['learnt']:g})."
    )
    return _yes_if(
        form.learnt_rest <= _T["not_learnt"]
        and (form.learnt_linear is None or form.learnt_linear >= _T["learnt"]),
        text,
    )


def _saturation(case: _Case) -> _Said:
    form, channels = case.numbers.form, case.numbers.channels
    excess = form.saturated - form.optimal_saturated
    worst = max(channels, key=lambda c: c.at_zero + c.at_one)
    return _yes_if(
        excess >= _T["excess_saturation"],
        f"{form.saturated:.0%} of action entries are at 0 or 1, of the optimum's "
        f"{form.optimal_saturated:.0%} (too many from {_T['excess_saturation']:.0%} more); most in "
        f"channel {worst.channel}: {worst.at_zero:.0%} at 0, {worst.at_one:.0%} at 1.",
    )


def _noise(case: _Case) -> _Said:
    share = case.numbers.form.noise
    return _yes_if(
        share >= _T["share_of_noise_or_clock"],
        f"{share:.0%} of the squared error is not the same when the policy is asked again in the "
        f"same state (from {_T['share_of_noise_or_clock']:.0%}).",
    )


def _reads_the_clock(case: _Case) -> _Said:
    form, clock = case.numbers.form, case.numbers.clock
    low, high = min(clock.normalised), max(clock.normalised)
    text = (
        f"In fixed states actions change by {sum(clock.moved) / len(clock.moved):.3f} with t/T, "
        f"which is {form.clock:.0%} of the squared error (from "
        f"{_T['share_of_noise_or_clock']:.0%}); ν is {low:.2f} at the best time and {high:.2f} at "
        "the worst. π* does not depend on it."
    )
    if case.spec.k > 1:
        text += f" With r_cum/k: {form.accumulated:.0%}."
    share = max(form.clock, form.accumulated)
    return _yes_if(share >= _T["share_of_noise_or_clock"] and not case.solved, text)


def _yes_if(holds: bool, text: str) -> _Said:
    return ("yes" if holds else "no"), text


# --- why: what a training shows of its causes ---------------------------------------------------


def _exploration(case: _Case) -> _Said:
    log, episodes = case.numbers.training, case.numbers.on_policy
    random = episodes.signal_random.paid
    tried = _tried(case)
    if log is None:
        return "cannot tell", (
            f"There is no log of a training. Uniform random actions are paid in {random:.1%} of "
            f"steps.{tried}"
        )
    own = episodes.scores[""].regret
    if log.source == "episodes" and log.last - own >= 0.1:
        tried += f" What it tries cost {log.last - own:.2f} of regret: {own:.2f} without it."
    if log.escaped_at is not None:
        return "no", (
            f"Training left the level of a constant action (regret {log.constant:.2f}) by step "
            f"{log.escaped_at:,}, so there was a reward that it found.{tried}"
        )
    if own < log.constant - 0.02:
        return "no", (
            f"The policy's own regret, {own:.2f}, is below that of a constant action "
            f"({log.constant:.2f}), though the log's never was.{tried}"
        )
    text = (
        f"In {log.steps:,} steps the running median of regret never fell below that of a constant "
        f"action ({log.constant:.2f}; its best is {log.best:.2f}), and uniform random actions are "
        f"paid in {random:.1%} of steps"
    )
    if random < _T["paid_at_random"]:
        return "yes", f"{text}: too rarely to be found (below {_T['paid_at_random']:.0%}).{tried}"
    return "cannot tell", (
        f"{text}: there was something to learn from, so what was tried may not be what failed."
        f"{tried}"
    )


def _tried(case: _Case) -> str:
    sd = case.numbers.exploration_sd
    if sd is None:
        return ""
    if max(sd) < 1e-6:
        return " At the end the algorithm tries nothing but its deterministic action."
    return f" At the end it still tries actions of SD {min(sd):.3f} to {max(sd):.3f} by channel."


def _credit(case: _Case) -> _Said:
    k, episodes = case.spec.k, case.numbers.on_policy
    if k == 1:
        return "no", "k = 1: every action is paid for itself."
    own, random = (
        "does not vary" if r is None else f"explains {r:.0%} of the payout it is credited with"
        for r in (episodes.credit, episodes.credit_random)
    )
    return "cannot tell", (
        f"k = {k}: an action's own reward {own} on policy, and {random} under random actions "
        "(100 % at k = 1). Whether that is why it fails, one run does not say: give "
        "--against a run with k = 1."
    )


def _sparsity(case: _Case) -> _Said:
    r_min, episodes = case.spec.r_min, case.numbers.on_policy
    signal, random = episodes.signal, episodes.signal_random
    flat = f"r̂ itself is 0 in {signal.flat:.0%} of its steps and {random.flat:.0%} of random ones"
    if r_min == 0:
        return "no", f"r_min = 0 hides nothing; {flat}."
    log = case.numbers.training
    unpaid = ""
    if log is not None and log.unpaid is not None:
        unpaid = f" In training {log.unpaid:.0%} of episodes had no reward at all."
    text = (
        f"r_min = {r_min:g} hides a graded reward in {signal.hidden:.0%} of its steps and "
        f"{random.hidden:.0%} of random ones (it counts from {_T['hidden_by_r_min']:.0%}); "
        f"{signal.paid:.0%} and {random.paid:.1%} are paid; {flat}. On average r̃ is "
        f"{signal.short:.3f} short of where reward begins.{unpaid}"
    )
    if signal.hidden >= _T["hidden_by_r_min"] and signal.paid <= 0.5:
        return "yes", text
    if signal.hidden + signal.flat < 0.05:
        return "no", text
    return "cannot tell", f"{text} Give --against a run with r_min = 0."


def _capacity(case: _Case) -> _Said:
    probe, own = case.numbers.capacity, case.numbers.own.normalised
    beyond = case.numbers.form.beyond_linear
    deep = f"π* has L = {case.spec.complexity}; {beyond:.0%} of its variance is beyond linear"
    if probe is None:
        return "cannot tell", f"{deep}. The network was not probed: --probe-capacity does it."
    text = (
        f"{deep}. The same network ({'–'.join(map(str, probe.layers))}), told a* in "
        f"{probe.states:,} states for {probe.gradient_steps:,} gradient steps, reaches ν "
        f"{probe.fitted:.2f} in these and {probe.held_out:.2f} in others; the agent has {own:.2f}"
    )
    if probe.held_out <= _T["probe_far_better"] * own:
        return "no", f"{text}: the network can do far better than the training made it do."
    if probe.fitted >= _T["probe_no_better"] * own:
        return "yes", f"{text}: even so it cannot, at least not within that budget."
    if probe.fitted <= _T["probe_far_better"] * own:
        return "no", f"{text}: it can hold them; what it lacks is other states (see dimension)."
    return "cannot tell", f"{text}: better, but not by half."


def _dimension(case: _Case) -> _Said:
    probe, own = case.numbers.capacity, case.numbers.own.normalised
    spec, random = case.spec, case.numbers.on_policy.signal_random
    size = f"S = {spec.state_dim}, A = {spec.action_dim}"
    if probe is not None and probe.fitted <= _T["probe_far_better"] * own:
        told = (
            f"{size}. Told a* in {probe.states:,} states, the same network reaches ν "
            f"{probe.held_out:.2f} in others (the agent: {own:.2f})"
        )
        if probe.held_out >= _T["probe_no_better"] * own:
            return "yes", f"{told}: so many states do not determine π* in so many dimensions."
        if probe.held_out <= _T["probe_far_better"] * own:
            return "no", f"{told}: as many states as the training had steps are enough."
    channels = case.numbers.channels
    bad = sum(c.normalised >= _T["unlearnt"] for c in channels)
    return "cannot tell", (
        f"{size}; {bad} of {len(channels)} action channels have ν from {_T['unlearnt']:g}, "
        f"and random actions are paid in {random.paid:.1%} of steps. Give --against a run with a "
        "smaller state_dim or action_dim, or --probe-capacity."
    )


def _survival(case: _Case) -> _Said:
    D, T, episodes = case.spec.D, case.spec.horizon, case.numbers.on_policy
    if D == 0:
        return "no", "D = 0: no episode ends early."
    text = (
        f"D = {D:g}{f' (with r_min, {max(D, case.spec.r_min):g})' if case.spec.r_min else ''}: "
        f"{episodes.terminated:.0%} of its episodes end early (from {_T['ended_by_D']:.0%} it "
        f"counts), after {episodes.mean_length:.0f} of {T} steps on average; of each state channel "
        f"at least {episodes.covered:.0%} is still entered."
    )
    log = case.numbers.training
    if log is not None and log.terminated is not None:
        text += f" In training {log.terminated:.0%} ended early."
    cut = episodes.terminated >= _T["ended_by_D"]
    return _yes_if(cut and episodes.mean_length <= 0.5 * T, text)


def _budget(case: _Case) -> _Said:
    log = case.numbers.training
    if log is None:
        return "cannot tell", "There is no log of a training."
    if log.rows < 10:
        return "cannot tell", f"The log has {log.rows} rows: too few for a trend (from 10)."
    back = log.last - log.best
    if back >= _T["fell_back"]:
        return "no", (
            f"It was better before: the running median of regret was {log.best:.2f} by step "
            f"{log.best_step:,} and is {log.last:.2f} at the end (a fall back from "
            f"{_T['fell_back']:g}). Training is unstable rather than short."
        )
    text = (
        f"Over the last third of {log.steps:,} steps the running median of regret fell by "
        f"{log.recent_gain:.3f}, to {log.last:.2f}"
    )
    if log.recent_gain >= _T["still_gaining"]:
        return "yes", f"{text} (from {_T['still_gaining']:g}): it was still learning. Train longer."
    text += f" (it counts from {_T['still_gaining']:g})"
    if log.escaped_at is None:
        return "cannot tell", f"{text}: it never began to learn, or not yet. Train longer to see."
    return "no", f"{text}: it has levelled off."


_WHERE: dict[str, Callable[[_Case], _Said]] = {
    "action channels": _channels,
    "state region": _state_region,
    "outside the cube": _shells,
    "time in the episode": _time,
    "states met": _states_met,
    "constant offset": _constant_offset,
    "reaction": _reaction,
    "only linear": _beyond_linear,
    "saturation": _saturation,
    "noise": _noise,
    "clock": _reads_the_clock,
}
_WHY: dict[str, Callable[[_Case], _Said]] = {
    "exploration": _exploration,
    "credit assignment": _credit,
    "sparsity": _sparsity,
    "capacity": _capacity,
    "dimension": _dimension,
    "survival": _survival,
    "budget": _budget,
}

# --- beside another run -------------------------------------------------------------------------

_AXES = {
    "k": "credit assignment",
    "r_min": "sparsity",
    "complexity": "capacity",
    "state_dim": "dimension",
    "action_dim": "dimension",
    "D": "survival",
}


def compare(here: Subject, numbers: Numbers, there: Subject, other: Numbers) -> Comparison:
    """What differs between two runs: what they were made of, and the main numbers."""
    fields: list[tuple[str, Callable[[Numbers], float]]] = [
        ("ν in uniform states", lambda n: n.own.normalised),
        ("error in uniform states", lambda n: n.own.error),
        ("regret in uniform states", lambda n: n.own.regret),
        ("ν of the linear policy", lambda n: n.uniform["linear_least_squares"].normalised),
        ("ν on policy", lambda n: n.on_policy.scores[""].normalised),
        ("regret on policy", lambda n: n.on_policy.scores[""].regret),
        ("ν in the outermost shell", lambda n: n.shells[-1].policies[""].normalised),
        ("share of steps paid", lambda n: n.on_policy.signal.paid),
        ("share of steps paid under random actions", lambda n: n.on_policy.signal_random.paid),
        ("share of squared error: offset", lambda n: n.form.offset),
        ("share of squared error: scale", lambda n: n.form.scale),
        ("saturated entries", lambda n: n.form.saturated),
    ]
    spec_here, spec_there = here.spec.to_dict(), there.spec.to_dict()
    plans = {**there.plan, **here.plan}
    return Comparison(
        name=there.name,
        spec_fields={
            field: (value, spec_there[field])
            for field, value in spec_here.items()
            if value != spec_there[field]
        },
        plan_fields={
            field: (here.plan.get(field), there.plan.get(field))
            for field in plans
            if here.plan.get(field) != there.plan.get(field)
        },
        differences=tuple(
            Difference(what=what, here=of(numbers), there=of(other)) for what, of in fields
        ),
        answers={},
    )


def _by_comparison(case: _Case, question: str) -> _Said | None:
    """What a run that differs in one axis alone says of that axis; None where it says nothing."""
    other = case.comparison
    if other is None or len(other.spec_fields) != 1 or other.plan_fields:
        return None
    (axis, (here, there)), *_ = other.spec_fields.items()
    if _AXES.get(axis) != question:
        return None
    nu = other.differences[0]
    text = (
        f"Only {axis} differs from {other.name}: {here} here, {there} there. ν is {nu.here:.2f} "
        f"here and {nu.there:.2f} there (it counts from {_T['difference']:g}). This is one run "
        "against one: another seed could move it as far, and a study gives the interval."
    )
    if abs(nu.here - nu.there) < _T["difference"] and nu.there >= _T["unlearnt"]:
        return "cannot tell", (
            f"{text} The run beside it has learnt next to nothing itself (ν from "
            f"{_T['unlearnt']:g}), so there was nothing to lose: train both longer."
        )
    return _yes_if(nu.here - nu.there >= _T["difference"], text)
