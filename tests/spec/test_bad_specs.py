"""Every bad document is refused with its field, its value, what is allowed, and what to do."""

import json

import numpy as np
import pytest

from sme_registry.errors import SMEError, SpecError
from sme_registry.spec import EnvFile, EvaluationProtocol, SMESpec, Suite

DEEP = []
for _ in range(900):
    DEEP = [DEEP]

# The largest valid value; the smallest is 1.
INTEGERS = {
    "state_dim": 2**20,
    "action_dim": 2**20,
    "k": 2**31 - 1,
    "complexity": 10_000,
    "horizon": 2**31 - 1,
    "hidden_width": 4096,
}
ONE = {"action_dim": 4}
BAD = [
    # fields, what the message must contain
    ({"k": np.True_}, ["k=np.True_: must be a valid integer in"]),
    ({"k": DEEP}, ["k=[[[", "must be a valid integer"]),
    ({"D": np.float32("nan")}, ["D=nan: must be a finite number"]),
    ({"policy_init": "unit"}, ["policy_init='unit': must be 'semi_orthogonal' or 'unit_variance'"]),
    (
        {"schema_version": 2},
        ["schema_version=2: a newer version wrote it. Upgrade: pip install --upgrade"],
    ),
    ({"seed": -1}, ["seed=-1: must be an integer in [0, 9007199254740992)"]),
    ({"seed": "7"}, ["seed='7': must be", "0x"]),
    ({"seed": "0xg"}, ["seed='0xg': must be"]),
    ({"seed": "0x" + "1" * 65}, ["seed='0x1111", "64 hex digits"]),
    ({"hiden_width": 3}, ["hiden_width=3: unknown field.", "Did you mean 'hidden_width'?"]),
    ({"zzz": 3}, ["zzz=3: unknown field.", "Known fields: schema_version, state_dim"]),
    ({7: 3}, ["Keys must be strings."]),
    ({"team": "two"}, ["team='two': must be a valid dictionary or instance of TeamSpec."]),
    ({"team": {}}, ["team.agents: missing. Add it."]),
    (
        {"team": {"agents": [ONE], "reward": "all"}},
        ["reward='all': must be 'individual' or 'team'."],
    ),
    ({"safety": {"tightness": 0.2}, "D": 0.25}, ["D=0.25: must be 0 with safety", "Leave D or"]),
    (
        {"safety": {"tightness": 0.2}, "team": {"agents": [ONE]}},
        ["safety={'tightness': 0.2}: must be null in a task for a team", "Leave safety or team"],
    ),
    (
        {"observation": {"distractors": 2}, "team": {"agents": [ONE]}},
        ["observation={'distractors': 2,", "must be null in a task for a team (1 agent)"],
    ),
]
BAD_AGENTS = [
    ([], "team.agents=[]: must have at least 1 item, not 0."),
    ([{"action_dim": 3}], "team.agents: their action channels add up to 3 … action_dim=4"),
    (
        [ONE, {"action_dim": "2"}],
        "team.agents.1.action_dim='2': must be a valid integer in [1, 1048576].",
    ),
    ([ONE | {"observes": [3, 1]}], "observes=[3, 1]: channels must be in incr … Write [1, 3]."),
    ([ONE | {"observes": []}], "team.agents.0.observes=[]: must be 'all' or"),
    ([ONE | {"observes": [8]}], "agent_0.observes=[8]: must be in [0, state_dim=8). … channel 8"),
    ([ONE | {"name": "the pilot"}], "name='the pilot': must be a word, '_' and a number, such as"),
    (
        [{"action_dim": 2, "name": "agent_1"}, {"action_dim": 2}],
        "team.agents: the name 'agent_1' appears twice. Rename one of them.",
    ),
]
BAD_SAFETY = [
    *[
        ({"tightness": tightness}, f"safety.tightness={tightness!r}: must be{kind} in (0, 0.5]. C")
        for tightness, kind in (
            (0, ""),
            (0.51, ""),
            (float("nan"), " a finite number"),
            ("0.2", " a valid number"),
            (True, " a valid number"),
        )
    ],
    ({}, "safety.tightness: missing. Add it."),
    ({"tightness": 0.2, "tau": 0.2}, "safety.tau=0.2: unknown field."),
]
SEEN = "observation.distractors=0: with mixing='none' the agent would see the state as"
BAD_OBSERVATION = [
    *[
        ({"distractors": number}, f"distractors={number}: must be{kind} in [0, 1048576].")
        for number, kind in ((-1, ""), (2**20 + 1, ""), (8.0, " a valid integer"))
    ],
    (
        {"distractors": 8, "dynamics": "random"},
        "observation.dynamics='random': must be 'noise', 'autonomous' or 'driven'.",
    ),
    ({"mixing": "linear"}, "mixing='linear': must be 'none', 'orthogonal' or 'nonlinear'."),
    (
        {"mixing": "nonlinear", "mixing_depth": 4},
        "observation.mixing_depth=4: must be in [1, 3].",
    ),
    (
        {"mixing": "orthogonal", "distractors": 2, "mixing_depth": 2},
        "mixing_depth=2: needs mixing='nonlinear'. Leave mixing_depth out, or",
    ),
    (
        {"mixing": "orthogonal", "dynamics": "driven"},
        "dynamics='driven': needs distractors > 0. Leave dynamics out, or",
    ),
    ({}, SEEN),
]  # fmt: skip
BAD += [({"team": {"agents": agents}}, words.split(" … ")) for agents, words in BAD_AGENTS]
BAD += [({"safety": safety}, [words]) for safety, words in BAD_SAFETY]
BAD += [({"observation": observation}, [words]) for observation, words in BAD_OBSERVATION]


def refusal(fields):
    with pytest.raises(SpecError) as caught:
        SMESpec.from_dict(fields)
    message = str(caught.value)
    assert len(message) < 500
    assert len(message.splitlines()) == 1
    return message


@pytest.mark.parametrize(("fields", "fragments"), BAD, ids=[str(b)[:50] for b, _ in BAD])
def test_the_error_of_a_bad_field_names_value_range_and_fix(fields, fragments):
    message = refusal(fields)
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize("field", INTEGERS)
def test_a_count_is_an_integer_in_its_range(field):
    default = SMESpec.model_fields[field].default
    for value in (0, -3, INTEGERS[field] + 1, "10", 1.0, True, None):
        message = refusal({field: value})
        words = "must be" if type(value) is int else "must be a valid integer"
        assert f"{field}={value!r}: {words} in [1, {INTEGERS[field]}]." in message
        assert message.endswith(f"or leave it out for the default, {default}.")


@pytest.mark.parametrize("field", ["r_min", "D"])
def test_a_threshold_is_a_finite_number_below_one(field):
    for value in (1, -1e-9, float("nan"), float("inf"), True, "0.5"):
        message = refusal({field: value})
        assert f"{field}={value!r}: must be" in message
        assert " in [0, 1)." in message


def test_all_errors_are_listed_at_once_by_the_constructor_too():
    fields = {"k": 0, "r_min": 2, "seeed": 1, "team": {"agents": [{"action_dim": 0}]}}
    with pytest.raises(SpecError) as of_dict:
        SMESpec.from_dict(fields)
    with pytest.raises(SpecError) as of_constructor:
        SMESpec(**fields)
    assert str(of_constructor.value) == str(of_dict.value)
    first, *lines = str(of_dict.value).splitlines()
    assert first == "SMESpec: "
    starts = [line.strip().split(":")[0] for line in lines]
    assert starts == ["k=0", "r_min=2", "team.agents.0.action_dim=0", "seeed=1"]


def test_deriving_refuses_as_parsing_does_and_a_source_begins_its_error():
    for document in ([], None):
        with pytest.raises(SpecError, match=r"^here\.json: (\[\]|None): must be a valid"):
            SMESpec.from_dict(document, "here.json")
    with pytest.raises(SpecError, match=r"complexiti=3: unknown field\. Did you mean 'complexity'"):
        SMESpec().derive(complexiti=3)
    with pytest.raises(SpecError, match="D=1: must be in"):
        SMESpec().derive(D=1)


@pytest.mark.parametrize(
    ("document", "fields", "fragment"),
    [
        (Suite, {"classes": []}, "classes: must have at least 1 entry, unless there are streams."),
        (
            Suite,
            {"classes": [{"name": "a", "setting": {}, "seeds": [1, 1]}]},
            "classes.0.seeds=[1, 1]: must be distinct.",
        ),
        (
            Suite,
            {"classes": [{"name": "a", "setting": {}, "seeds": [i]} for i in (1, 2)]},
            "classes: the name 'a' appears twice.",
        ),
        (
            Suite,
            {
                "classes": [{"name": "a", "setting": {}, "seeds": [1]}],
                "streams": [{"name": "a", "stream": "Cycle2"}],
            },
            "streams: the name 'a' appears twice.",
        ),
        (EvaluationProtocol, {"epsilons": [0.0]}, "epsilons=[0.0]: must increase, from above 0."),
        (EvaluationProtocol, {"states_per_region": 1}, "states_per_region=1: must be in [2, "),
        (EnvFile, SMESpec().to_dict(), "digest: missing: must be the digest of the spec."),
        (
            EnvFile,
            {"digest": "", "spec": {"team": {"agents": [{"action_dim": 1}]}}, "fingerprint": {}},
            "spec.team.agents: their action channels add up to 1",
        ),
        (EnvFile, {"name": "a b"}, "name='a b': must be a string of 1 to 64 letters, digits"),
        (EnvFile, {"digest": "sha256:AB"}, "digest='sha256:AB': must be 'sha256:' and 64"),
        (EnvFile, {"description": "x" * 2001}, "must have at most 2000 characters."),
        (EnvFile, {"description": "\ud800"}, "description='\\ud800': must be a valid string"),
        (EnvFile, {"tags": ["a b"]}, "tags.0='a b': "),
        (EnvFile, {"fingerprint": {"optimal_action": [["x"]]}}, "optimal_action.0.0='x': "),
    ],
)
def test_other_documents_are_refused_as_clearly(document, fields, fragment):
    with pytest.raises(SpecError) as caught:
        document.from_dict(fields)
    assert isinstance(caught.value, SMEError)
    assert isinstance(caught.value, ValueError)
    assert fragment in str(caught.value)


def test_a_message_of_a_bad_field_is_plain_text_that_json_can_carry():
    message = refusal({"k": "\x00\u202e" * 50})
    assert "\x00" not in message
    assert json.dumps(message)
