"""Every verdict that the rules can give has a sentence, and no sentence lacks a number."""

import random
import re
from itertools import chain

import pytest

from sme_registry import SMESpec
from sme_registry.diagnosis import diagnose, load_policy
from sme_registry.diagnosis.behaviour import CapacityProbe, TrainingSummary
from sme_registry.diagnosis.document import Measurements
from sme_registry.diagnosis.questions import COMMON_REASONS, DOUBTS, Comparison, Difference, label
from sme_registry.diagnosis.task import TASK_QUESTIONS
from tests.diagnosis.policies import (
    EXTENDED,
    SPEC,
    diagnosis_of,
    near_the_centre_only,
    network,
    printed,
    shrunk,
    verdicts_on,
)

COMPARED = COMMON_REASONS.keys() - {"solved", *DOUBTS}
DECLARED = {
    (question, reason)
    for question, rule in TASK_QUESTIONS.items()
    if "critic" not in rule.needs  # test_critic.py has these
    for reason in (*rule.reasons, *(["solved"] if rule.kind == "why" else ()))
} | {
    (question, reason)
    for question in ("credit_assignment", "sparsity", "capacity", "dimension", "survival")
    for reason in COMPARED
}
FIELDS = {"k": (5, 1), "r_min": (0.5, 0.0), "complexity": (10, 1), "state_dim": (16, 8),
          "action_dim": (8, 4), "D": (0.5, 0.0)}  # fmt: skip


def scrambled(value, generator):
    """The same document with other numbers in [−0.1, 1.1], some of them equal to 0."""
    if isinstance(value, dict):
        return {name: scrambled(part, generator) for name, part in value.items()}
    if isinstance(value, list | tuple):
        scale = generator.choice((0.1, 1.0))  # even lists, and lists below a threshold, too
        return [scrambled(part, generator) if not isinstance(part, float)
                else scale * scrambled(part, generator) for part in value]  # fmt: skip
    if isinstance(value, float):
        return generator.choice((0.0, generator.uniform(-0.1, 1.1), generator.uniform(0, 0.1)))
    return value


def optional(model, generator):
    """A document with random numbers, or None."""
    if generator.random() < 0.3:
        return None
    number, fields = generator.random, model.model_fields
    values = {name: generator.choice((0.0, number(), 0.1 * number())) for name in fields}
    values |= {"rows": generator.choice((5, 100)), "steps": 20_000, "best_step": 10_000}
    values |= {"improvement_step": generator.choice((None, 9_000)), "window": 2}
    values |= {"layers": (10, 64, 4), "states": 20_000, "gradient_steps": 3_000}
    values |= {"source": "episodes"}
    if generator.random() < 0.5:
        values |= {"unrewarded": None, "termination_rate": None}
    return model(**{name: values[name] for name in fields})


PLAIN = SPEC, SPEC.derive(k=5, r_min=0.5, D=0.3)


def random_verdicts(count, policy=shrunk, specs=PLAIN):
    """The verdicts on random measurements, on tasks with every axis on or off."""
    generator = random.Random(0)
    plain = diagnosis_of(policy, specs[0], states=64).measurements.to_dict()
    for _ in range(count):
        measured = Measurements.from_dict(scrambled(plain, generator), "random")
        channels = measured.channels
        if generator.random() < 0.5:  # one channel learnt and one not
            low, high = ({"normalised_regret": x, "slope": 3.0} for x in (0.1, 1.0))
            channels = (channels[0].model_copy(update=low), channels[1].model_copy(update=high))
        measured = measured.model_copy(
            update={
                "channels": channels,
                "training": optional(TrainingSummary, generator),
                "capacity": optional(CapacityProbe, generator),
                "exploration_sd": generator.choice((None, (0.0, 0.0), (0.1, 0.3))),
            }
        )
        if measured.observation is not None and generator.random() < 0.2:
            unknown = measured.observation.model_copy(update={"probes": ()})
            measured = measured.model_copy(update={"observation": unknown})
        spec = generator.choice(specs)
        comparison = None
        if generator.random() < 0.5:
            field = generator.choice(list(FIELDS))
            regret = Difference(
                quantity="normalised_regret",
                value=generator.choice((0.5, 0.55, 0.55, 0.95)),
                other=generator.choice((0.5, 0.5, 0.95)),
            )
            comparison = Comparison(
                name="the other", spec_fields={field: FIELDS[field]}, plan_fields={},
                differences=(regret,), answers={},
            )  # fmt: skip
        yield from verdicts_on(measured, spec, comparison, generator.choice((None, 10, 30)))


def test_every_question_and_reason_is_reached_and_has_a_sentence():
    reached = set()
    for verdict in chain(random_verdicts(3000), random_verdicts(500, network(), (EXTENDED,))):
        if verdict.reason not in DOUBTS:
            reached.add((verdict.question, verdict.reason))
        else:
            assert verdict.answer == "cannot tell"
            reached.add((verdict.question, verdict.evidence["own_reason"]))
        text = verdict.sentence()
        assert text.endswith(".")
        assert not any(bad in text for bad in ("None", " ,", " .")), text
        assert not re.search(r"[.)][A-Z]", text), text  # a space is missing
        if verdict.reason in COMPARED.union(DOUBTS):
            own = (verdict.question, verdict.evidence["own_reason"])
            assert own in DECLARED
            decided = verdict.evidence["own_answer"] != "cannot tell"
            assert ("Without the comparison" in text) == decided
    assert reached == DECLARED


@pytest.fixture(scope="module")
def compared():
    """A diagnosis against a run in a task of two other fields."""
    other = load_policy(shrunk, SMESpec(horizon=20, k=5, r_min=0.5), name="other")
    return diagnose(load_policy(shrunk, SPEC), against=other, states=64, episodes=8)


def test_markdown_holds_every_sentence_the_headline_and_the_figures(compared):
    unfinished = compared.model_copy(update={"checkpoint_step": 1234})
    page = unfinished.markdown(["a_b.png"], details=True)
    for verdict in compared.verdicts:
        assert verdict.sentence().replace("|", r"\|") in page
    assert compared.headline() in page
    assert "1,234" in page
    assert "![a b](a_b.png)" in page
    tables = [line for line in page.splitlines() if line.startswith("|")]
    rules = [line for line in tables if set(line) <= {"|", "-"}]
    assert len(rules) == sum(bool(part.rows) for part in compared.parts())
    assert len(compared.markdown()) < len(page) / 2
    assert all(line.endswith("|") for line in tables)


@pytest.mark.parametrize("width", [60, 120, None])
def test_a_diagnosis_is_readable_at_every_width_and_in_a_pipe(compared, width):
    lines = printed(compared, width)
    assert max(map(len, lines)) <= (width or 80)
    shown = " ".join(" ".join(lines).split())
    assert compared.headline() in shown
    found = [verdict for verdict in compared.verdicts if verdict.answer == "yes"]
    assert found
    for verdict in compared.verdicts:
        assert label(verdict.question) in shown
        assert width is not None or (verdict.sentence() in shown) == (verdict in found)
    if width is None:
        line = next(i for i, line in enumerate(lines) if line.startswith("response scale: yes"))
        assert lines[line + 1].startswith("    ")
    details = " ".join(" ".join(printed(compared, width, details=True)).split())
    assert width is not None or all(v.sentence() in details for v in compared.verdicts)


def test_findings_are_sorted_by_their_share_of_the_error():
    diagnosis = diagnosis_of(near_the_centre_only)
    answers = [answer for _, answer, _ in diagnosis.findings("Findings", diagnosis.verdicts).rows]
    shares = [int(answer.removeprefix("yes, ")[:-1]) for answer in answers if answer != "yes"]
    assert shares == sorted(shares, reverse=True)
    assert 1 < len(shares) < len(answers)
    assert answers[len(shares) :] == ["yes"] * (len(answers) - len(shares))
