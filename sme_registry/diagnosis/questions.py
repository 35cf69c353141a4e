"""Questions: a rule, the answer that each of its reasons gives, and what makes an answer a verdict.

A rule reads the measurements of one run. A cause stays open, whatever its rule says, where the run
has learnt little, its algorithm had few updates, or the evidence is one other run.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from pydantic import JsonValue

from sme_registry.io.markup import environment
from sme_registry.spec.document import Real, StrictModel, TupleOf

if TYPE_CHECKING:
    from jinja2 import Environment

Answer = Literal["yes", "no", "cannot tell"]
Kind = Literal["who", "where", "why", "limits"]

THRESHOLDS = {
    "solved": 0.1,  # normalised regret at most: nothing is left to explain
    "constant_level": 0.95,  # normalised regret at least: no better than the constant ½
    "unlearnt": 0.9,  # normalised regret of a channel, at least
    "channel_learnt": 0.6,  # normalised regret of a channel, at most
    "excess_saturation": 0.2,  # share of entries at a bound beyond the optimum's
    "dominant_share": 0.5,  # of the squared error, for an offset or a scale
    "noise_or_time_share": 0.25,  # of the squared error
    "explained_variance": 0.1,  # share of the errors' variance between bins
    "bin_ratio": 1.5,  # of the worst bin's error to the best bin's
    "slope_learnt": 0.7,  # slope on a part of π*, at least
    "slope_unlearnt": 0.3,  # at most
    "nonlinear_variance": 0.1,  # share of π*'s variance, at least
    "similarity_loss": 10.0,  # points, from WD to the outermost shell
    "on_policy_ratio": 1.25,  # of normalised regret on policy and in uniform states
    "on_policy_difference": 0.05,  # between the two
    "time_ratio": 1.25,  # of the error late and early in episodes
    "time_difference": 0.02,  # between the two
    "gated_share": 0.25,  # of steps whose reward r_min sets to 0
    "gated_rewarded_share": 0.5,  # of steps that are rewarded nevertheless, at most
    "rarely_unrewarded": 0.05,  # share of steps without reward, below
    "rarely_rewarded": 0.02,  # share of steps rewarded under random actions, below
    "termination_rate": 0.5,  # share of episodes that D terminates, in a team because of one agent
    "short_episode": 0.5,  # mean length over the horizon, at most
    "constant_margin": 0.02,  # of regret below the constant action's
    "exploration_cost": 0.1,  # regret of training beyond the policy's, to be reported
    "log_rows": 10.0,  # for a trend, at least
    "still_improving": 0.02,  # fall of the running median of regret over the last third
    "regressed": 0.1,  # its rise from its best
    "probe_better": 0.5,  # the probe's normalised regret over the agent's, at most
    "probe_no_better": 0.8,  # at least
    "difference": 0.1,  # of normalised regret between two runs, at least
    "no_difference": 0.02,  # at most: the run is about as good as the other, or better
    "learnt_little": 0.8,  # normalised regret of a run, at least: it says nothing about causes
    "few_updates": 20.0,  # of the algorithm, below: likewise
    # of limits and distractors
    "rarely_violating": 0.05,  # share of states in which a limit is violated, below
    "gain": 0.01,  # of step reward by violating, at least
    "price_share": 0.5,  # the price of safety over the policy's regret, at least
    "distractor_loss": 10.0,  # points of similarity, from distractors in the cube to the outermost
    "kept_r2": 0.5,  # held-out R² of a linear map of a layer, at least
    "owed_to_distractors": 0.05,  # normalised regret, at least
    "invariant": 0.01,  # change of actions by other distractors over mean |½ − a*|, at most
    # of critics
    "ranks_well": 0.8,  # share of pairs of actions in the order of their rewards, at least
    "ranks_badly": 0.65,  # below; chance is 0.5
    "actor_lags": 0.3,  # normalised regret, at least
    "level_bias": 0.2,  # of the critic's level, over the mean size of the value, at least
    "maturity": 2.0,  # (1 − γ) τ updates, below
    # of teams
    "blame_ratio": 1.5,  # of an agent's share of the regret to its share of the channels
    "one_suffices": 0.5,  # share of the team's regret that correcting one agent removes, at least
    # of lives
    "fresh_excess": 0.05,  # of a visit's online regret beyond a fresh agent's
    "visit_excess": 0.1,  # of it beyond the mean of the other visits
    "visits_for_trend": 4.0,  # at least, without fresh agents
    "inactive_rise": 0.1,  # of the share of inactive units
    "inactive_share": 0.5,  # of the units, from the start
    "rank_ratio": 0.5,  # of the effective rank to what it is compared with, at most
    "weight_ratio": 2.0,  # of the weight norm to what it is compared with, at least
}

TINY = 1e-9  # in place of 0 where a share is of it

COMMON_REASONS: dict[str, Answer] = {
    "solved": "no",  # of every "why"
    "learnt_little": "cannot tell",  # of every cause
    "few_updates": "cannot tell",  # likewise
    "field_raises_regret": "cannot tell",  # these are of a cause that is a field of the spec
    "regret_same_or_lower": "no",
    "difference_too_small": "cannot tell",
    "other_run_learnt_little": "cannot tell",
}
"""In place of a rule's own reasons."""

DOUBTS = ("learnt_little", "few_updates")
"""Why a run that seems to show a cause does not."""

_OF_CAUSES = ("solved", "learnt_little", "few_updates", "difference", "no_difference")
"""Thresholds of every question about a cause."""

_EXPERIMENTS = {"network_cannot_fit", "too_few_states"}
"""Reasons whose evidence is a probe, and not the run."""

_FIELD_QUESTIONS = {
    "k": "credit_assignment",
    "r_min": "sparsity",
    "complexity": "capacity",
    "state_dim": "dimension",
    "action_dim": "dimension",
    "D": "survival",
}


class Verdict(StrictModel):
    """The answer to one question, as data; `sentence` puts it in words.

    Attributes:
      question: such as "sparsity".
      kind: "where" the error is, "why" it is there, "who" in a team makes it, or "limits".
      answer: "cannot tell" if the evidence does not separate the causes.
      reason: the rule's branch that decided.
      evidence: the numbers that the branch compared or reports.
      thresholds: those of the question, with which the numbers were compared.
      error_share: part of the error that a "yes" explains; null if it is not measured.
    """

    question: str
    kind: Kind
    answer: Answer
    reason: str
    evidence: dict[str, JsonValue]
    thresholds: dict[str, Real]
    error_share: Real | None = None

    def sentence(self) -> str:
        """The reason, with its evidence and thresholds, in a few sentences."""
        if "own_reason" not in self.evidence:
            return self._words(self.reason)
        answer = self.evidence["own_answer"]
        if answer == "cannot tell":
            return self.doubt
        own = self._words(str(self.evidence["own_reason"]))
        return f"{self.doubt} Without the comparison, the answer would be {answer}: {own}"

    @property
    def doubt(self) -> str:
        """Why the rule's own reason does not decide."""
        macro = self.reason if self.reason in DOUBTS else "compared"
        return self._words(self.reason, macro)

    def _words(self, reason: str, macro: str = "") -> str:
        """What a reason says, then the numbers."""
        if plain := words("plain", reason):
            return plain
        numbers = words(macro or self.question, reason, self.evidence, self.thresholds)
        return f"{words('phrase', reason)} {numbers}".strip()


def label(question: str) -> str:
    """`credit_assignment` as people read it: `credit assignment`."""
    return question.replace("_", " ")


@cache
def templates() -> Environment:
    """The page and the sentences."""
    folder = environment(Path(__file__).parent / "templates", autoescape=False)
    folder.filters["label"] = label
    return folder


def words(macro: str, *arguments: Any) -> str:
    """What a macro of the sentences says, on one line."""
    sentences: Any = templates().get_template("sentences.jinja").module
    return " ".join(getattr(sentences, macro)(*arguments).split())


class Decision(NamedTuple):
    """A rule's branch and its evidence."""

    reason: Any  # one of the question's; of a rule also a bool, for the first that says yes or no
    evidence: dict[str, Any]
    error_share: float | None = None  # that a "yes" explains


class Difference(StrictModel):
    """A quantity of this run and of the other run."""

    quantity: str  # its name
    value: Real  # of this run
    other: Real  # of the other run

    @property
    def difference(self) -> float:
        return self.value - self.other


class Comparison(StrictModel):
    """This run compared with another; pairs are (this run, other run)."""

    name: str  # of the other run
    spec_fields: dict[str, TupleOf[JsonValue]]  # those that differ
    plan_fields: dict[str, TupleOf[JsonValue]]  # likewise
    differences: TupleOf[Difference]  # of the main quantities; the first is normalised regret
    answers: dict[str, TupleOf[Answer]]  # to each question whose answers differ

    def bears_on(self, question: str) -> bool:
        """Whether the runs differ in the question's field alone, and this one has the harder task.

        Each field makes a task harder at a higher value.
        """
        if len(self.spec_fields) != 1 or self.plan_fields:
            return False
        ((field, (value, other)),) = self.spec_fields.items()
        return _FIELD_QUESTIONS.get(field) == question and value > other  # type: ignore[operator]

    def decide(self, answer: Answer, *, is_cause: bool, is_open: bool) -> Decision | None:
        """What the regrets decide of a question that this bears on, where they decide anything.

        The run alone has this answer, which names a cause of which it is a sign, or leaves it open.
        """
        regret = self.differences[0]
        if regret.difference >= THRESHOLDS["difference"]:
            reason, decides = "field_raises_regret", is_open or answer != "yes"
        elif regret.other >= THRESHOLDS["learnt_little"]:
            reason, decides = "other_run_learnt_little", is_cause or answer == "cannot tell"
        elif regret.difference <= THRESHOLDS["no_difference"]:
            reason, decides = "regret_same_or_lower", True
        else:
            reason, decides = "difference_too_small", is_cause or answer == "cannot tell"
        ((field, (value, other)),) = self.spec_fields.items()
        evidence = {
            "field": field,
            "value": value,
            "other_value": other,
            "other_run": self.name,
            "normalised_regret": regret.value,
            "other_normalised_regret": regret.other,
        }
        return Decision(reason, evidence) if decides else None


class Question(NamedTuple):
    """A question: its kind, its rule, and the answer that each reason gives."""

    kind: Kind
    rule: Callable[..., Decision]  # of a diagnosis without verdicts, and what it `needs` measured
    thresholds: tuple[str, ...]  # that decide on its answer
    reasons: dict[str, Answer]
    needs: tuple[str, ...] = ()  # fields of `Measurements` without which it is not asked
    is_cause: bool = False  # whether "yes" names a cause, which a run can leave open

    def decide(self, diagnosis: Any) -> Decision:
        """What the rule decides, with its reason by name."""
        decision = self.rule(diagnosis, *(getattr(diagnosis.measurements, n) for n in self.needs))
        if isinstance(decision.reason, str):
            return decision
        answer = "yes" if decision.reason else "no"
        first = next(reason for reason, given in self.reasons.items() if given == answer)
        return decision._replace(reason=first)


Questions = dict[str, Question]
_Rule = TypeVar("_Rule", bound=Callable[..., Decision])


def add_to(
    questions: Questions,
    kind: Kind,
    *,
    yes: str = "",
    no: str = "",
    unclear: str = "",
    thresholds: str = "",
    needs: str = "",
    is_cause: bool = False,
) -> Callable[[_Rule], _Rule]:
    """Decorate a rule: add the question of its name, with the reasons for each answer."""
    used = (*thresholds.split(), *(_OF_CAUSES if is_cause else ()))
    reasons: dict[str, Answer] = {
        **dict.fromkeys(yes.split(), "yes"),
        **dict.fromkeys(no.split(), "no"),
        **dict.fromkeys(unclear.split(), "cannot tell"),
    }

    def add(rule: _Rule) -> _Rule:
        name = rule.__name__.removeprefix("_")
        questions[name] = Question(kind, rule, used, reasons, tuple(needs.split()), is_cause)
        return rule

    return add


def judge(name: str, question: Question, diagnosis: Any) -> Verdict:
    """The answer to a question about a diagnosis that has no verdicts yet."""
    if question.kind == "why" and diagnosis.solved:
        decision = Decision("solved", {"normalised_regret": diagnosis.learnt})
    else:
        decision = _decided(name, question, diagnosis)
    answer = {**COMMON_REASONS, **question.reasons}[decision.reason]
    share = decision.error_share
    return Verdict(
        question=name,
        kind=question.kind,
        answer=answer,
        reason=decision.reason,
        evidence=decision.evidence,
        thresholds={threshold: THRESHOLDS[threshold] for threshold in question.thresholds},
        error_share=None if answer != "yes" or share is None else min(max(share, 0.0), 1.0),
    )


def _decided(name: str, question: Question, diagnosis: Any) -> Decision:
    """What the rule decides, unless a comparison or a doubt overrules it."""
    own = question.decide(diagnosis)
    answer = question.reasons[own.reason]
    is_cause = question.is_cause and answer == "yes" and own.reason not in _EXPERIMENTS
    overruling = doubt = _doubt(diagnosis) if is_cause else None
    comparison: Comparison | None = getattr(diagnosis, "comparison", None)
    if comparison is not None and comparison.bears_on(name):
        compared = comparison.decide(answer, is_cause=is_cause, is_open=doubt is not None)
        overruling = compared or doubt
    if overruling is None:
        return own
    evidence = {**own.evidence, "own_answer": answer, "own_reason": own.reason}
    return overruling._replace(evidence=evidence | overruling.evidence)


def _doubt(diagnosis: Any) -> Decision | None:
    """Why the run cannot name a cause; None if it can."""
    if diagnosis.updates is not None and diagnosis.updates < THRESHOLDS["few_updates"]:
        return Decision("few_updates", {"updates": diagnosis.updates})
    if diagnosis.learnt >= THRESHOLDS["learnt_little"]:
        return Decision("learnt_little", {"learnt": diagnosis.learnt})
    return None
