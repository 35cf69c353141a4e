"""Policies: callables, SB3 models and files, and what is refused of each."""

import io
import json
import sys
import warnings
import zipfile

import numpy as np
import pytest

import sme_registry
from sme_registry.errors import (
    MissingDependencyError,
    OptionError,
    PolicyError,
    UnknownNameError,
)
from sme_registry.evaluation import evaluate, references
from sme_registry.evaluation.models import load_sb3, saved_sb3
from sme_registry.evaluation.networks import OfflinePolicy
from sme_registry.evaluation.policies import as_policy
from sme_registry.spec import SMESpec
from sme_registry.training.numpy_policy import numpy_policy
from tests.commands import good, sme

SPEC = SMESpec(state_dim=3, action_dim=2)
PROTOCOL = {"states_per_region": 200, "epsilons": [0.5, 1.0]}
NO_POLICY = r"must be a callable from observations \[B, 5\]"


def constant(*action):
    return lambda observations: np.tile(action, (len(observations), 1))


def evaluated(policy, **kw):
    return evaluate(policy, SPEC, PROTOCOL, **kw)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda o: np.zeros((len(o), 3)), r"shape \(200, 3\): must be of shape \(200, 2\)"),
        (lambda o: np.zeros(len(o)), r"shape \(200,\): must be of shape \(200, 2\)"),
        (lambda o: 0.5, r"must be of shape \(200, 2\)"),
        (lambda o: None, "must be numbers"),
        (lambda o: [[0.0], [0.0, 1.0]], "must be an array of shape"),
        (lambda o: np.full((len(o), 2), np.nan), "NaN or infinite"),
        (lambda o: 1 / 0, "ZeroDivisionError: division by zero"),
        *[(each, NO_POLICY) for each in (None, 3, [0.5, 0.5], {"a": 1})],
    ],
)
def test_what_is_no_policy_or_acts_badly_is_refused_by_what_is_wrong(policy, message):
    with pytest.raises(PolicyError, match=message):
        evaluated(policy)


def test_a_policy_is_given_float32_observations_that_it_may_overwrite():
    seen = []

    def overwriting(observations):
        seen.append((observations.dtype, observations.shape))
        actions = observations[:, :2].copy()
        observations[:] = 7.0
        return actions

    honest = evaluated(lambda o: o[:, :2], name="overwriting")
    assert evaluated(overwriting) == honest
    assert seen == [(np.float32, (200, 5))] * 3


def test_symmetric_actions_are_rescaled():
    symmetric = evaluated(constant(-0.5, 1.0), action_range="symmetric")
    assert symmetric.action_range == "symmetric"
    assert symmetric.regions == evaluated(constant(0.25, 1.0)).regions
    with pytest.raises(OptionError, match="action_range='wide': must be 'unit' or 'symmetric'"):
        evaluated(constant(0.5, 0.5), action_range="wide")
    with pytest.raises(PolicyError, match=r"actions of policy 'linear' are in \[0, 1\]. Leave it"):
        evaluated("linear", action_range="symmetric")


@pytest.mark.parametrize("reference", references.NAMES)
def test_a_reference_policy_goes_by_the_name_that_reports_use(reference):
    report = evaluated(reference)
    assert report.policy == reference
    for row, expected in zip(report.regions, report.references[reference], strict=True):
        assert row.similarity == pytest.approx(expected.similarity, abs=0.05)
    for old, new in references.OLD_NAMES.items():
        if new == reference:
            assert evaluated(old) == report


def test_a_reference_policys_actions_are_in_the_unit_range():
    policy = references.reference_policy("linear", SMESpec())
    actions = policy(np.random.default_rng(0).random((4000, 10), np.float32))
    assert (actions.min(), actions.max()) == (0.0, 1.0)
    with pytest.raises(OptionError, match="Did you mean 'linear'"):
        references.reference_policy("liner", SMESpec())


def test_a_function_goes_by_its_module_and_name(tmp_path, monkeypatch):
    (tmp_path / "policies_for_a_test.py").write_text("def act(o):\n    return o[:, :2]\nx = 3\n")
    monkeypatch.chdir(tmp_path)
    report = evaluated("policies_for_a_test:act")
    assert report.policy == "policies_for_a_test:act"
    assert report.regions == evaluated(lambda o: o[:, :2]).regions


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("sys:maxsize", PolicyError, "is a int: must be a function"),
        ("no_such_module:act", PolicyError, "cannot be imported"),
        ("liner", UnknownNameError, "Did you mean 'linear'"),
        ("/", PolicyError, "is a folder"),
    ],
)
def test_an_unusable_name_is_refused(name, error, message):
    with pytest.raises(error, match=message):
        evaluated(name)


def test_a_prepared_policy_is_accepted_as_it_is():
    prepared = as_policy(constant(-0.5, 1.0), SPEC, action_range="symmetric", name="mine")
    again = as_policy(prepared, SPEC)
    assert (again.name, again.action_range) == ("mine", "symmetric")
    assert evaluated(prepared) == evaluated(
        constant(-0.5, 1.0), action_range="symmetric", name="mine"
    )
    assert as_policy(prepared, SPEC, name="other").name == "other"
    assert as_policy(evaluated, SPEC).name == "evaluated"
    with pytest.raises(PolicyError, match=r"its actions have shape \(2,\): must be \(1,\)"):
        evaluate(prepared, SPEC.derive(action_dim=1), PROTOCOL)


def archive(data):
    """A .zip that says this of its model."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        file.writestr("data", data)
    return content.getvalue()


NO_MODEL = "not a model that Stable-Baselines3 saved"
NO_NETWORK = "not a network that onnxruntime can load"
OF_CONTRIB = '{"policy_class": {"__module__": "sb3_contrib.tqc.policies"}}'


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("absent.zip", None, "does not exist"),
        ("text.zip", b"hello", NO_MODEL),
        ("cut.zip", archive("{not json"), NO_MODEL),
        (
            "unsaid.zip",
            archive('{"exploration_fraction": 0.1}'),
            "does not tell its algorithm. Give the algorithm's class",
        ),
        ("tqc.zip", archive(OF_CONTRIB), "cannot be loaded as a model of sb3_contrib:TQC"),
        ("absent.onnx", None, r"does not exist. Give the path of an \.onnx"),
        ("text.onnx", b"hello", NO_NETWORK),
    ],
    ids=lambda value: value if isinstance(value, str) and "." in value[-5:] else "",
)
def test_a_file_that_is_no_model_is_refused(tmp_path, name, content, message):
    pytest.importorskip("onnxruntime" if name.endswith(".onnx") else "stable_baselines3")
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(PolicyError, match=message):
        evaluated(str(tmp_path / name))


@pytest.fixture(scope="module")
def sb3():
    return pytest.importorskip("stable_baselines3")


def untrained(package, algorithm, action_range="unit", policy="MlpPolicy"):
    env = sme_registry.make(SPEC, action_range=action_range)
    return getattr(package, algorithm)(policy, env, device="cpu", seed=3)


@pytest.mark.parametrize(
    "algorithm", ["PPO", "A2C", "SAC", "TD3", "TQC", "TRPO", "CrossQ", "RecurrentPPO"]
)
def test_a_saved_model_is_loaded_as_what_it_is_and_scores_as_the_model(sb3, algorithm, tmp_path):
    package = sb3 if hasattr(sb3, algorithm) else pytest.importorskip("sb3_contrib")
    policy = "MlpLstmPolicy" if algorithm == "RecurrentPPO" else "MlpPolicy"
    model = untrained(package, algorithm, "symmetric", policy)
    model.save(tmp_path / "agent.zip")
    assert type(load_sb3(tmp_path / "agent.zip")) is type(model)
    live, saved = evaluated(model), evaluated(tmp_path / "agent.zip")
    assert (live.policy, saved.policy) == (algorithm, "agent")
    assert saved.regions == live.regions
    assert live.action_range == saved.action_range == "symmetric"


@pytest.mark.parametrize(
    "command", [["evaluate", "never:act", "Plane1"], ["diagnose", "never:act", "--task", "Plane1"]]
)
def test_an_output_that_cannot_be_written_is_refused_before_the_policy_acts(
    command, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "never.py").write_text("def act(observations):\n    raise SystemExit(3)\n")
    result = sme(*command, "--out", "never.py/out")
    assert result.exit_code == 2
    assert "cannot be written" in result.output.replace("\n", " ")


class Shy:
    """A policy class outside of the packages whose algorithms are known."""


def test_a_saved_model_tells_its_class_if_we_save_it(sb3, tmp_path):
    model = untrained(sb3, "DDPG")
    path = tmp_path / "agent.zip"
    model.policy_class = Shy  # hides the algorithm
    model.save(path)
    with pytest.raises(
        PolicyError, match=r"does not tell its algorithm \(its policy is of .*tests"
    ):
        load_sb3(path)
    model.policy_class = sb3.DDPG.policy_aliases["MlpPolicy"]
    path.write_bytes(saved_sb3(model))
    assert type(load_sb3(path)) is sb3.DDPG


def test_the_algorithm_of_a_model_can_be_given(sb3, tmp_path):
    model = untrained(sb3, "DDPG")
    model.save(tmp_path / "agent.zip")
    assert type(load_sb3(tmp_path / "agent.zip")) is sb3.TD3  # which acts equally
    for algorithm in ("ddpg", "stable_baselines3:DDPG"):
        assert type(load_sb3(tmp_path / "agent.zip", algorithm)) is sb3.DDPG
        report = evaluated(str(tmp_path / "agent.zip"), algorithm=algorithm)
        assert (report.policy, report.regions) == ("agent", evaluated(model).regions)
    for algorithm, message in {
        "TD4": "must be one of .* Did you mean 'TD3'",
        "math:sqrt": "must be a class with a method `load`",
        "PPO": "cannot be loaded as a model of stable_baselines3:PPO",
    }.items():
        with pytest.raises(PolicyError, match=message):
            evaluated(tmp_path / "agent.zip", algorithm=algorithm)
    with pytest.raises(PolicyError, match="is for the path of a model"):
        evaluated(model, algorithm="DDPG")


def test_a_model_that_predicts_in_its_own_way_is_asked_for_its_predictions(sb3):
    class Halved(sb3.PPO):
        def predict(self, *args, **kwargs):
            actions, state = super().predict(*args, **kwargs)
            return actions / 2.0, state

    env = sme_registry.make(SPEC)
    model = Halved("MlpPolicy", env, device="cpu", seed=3)
    expected = evaluated(lambda o: model.predict(o, deterministic=True)[0]).regions
    assert evaluated(model).regions == expected
    observations = np.random.default_rng(0).random((9, 5), dtype=np.float32)
    actions = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(numpy_policy(model, SPEC)(observations), actions)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
@pytest.mark.parametrize("algorithm", ["PPO", "TD3"])
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_a_model_scores_as_its_deterministic_predictions(sb3, algorithm, action_range):
    model = untrained(sb3, algorithm, action_range)
    own = evaluated(model)
    assert own.action_range == action_range
    predicted = evaluated(
        lambda o: model.predict(o, deterministic=True)[0], action_range=action_range
    )
    for mine, theirs in zip(own.regions, predicted.regions, strict=True):
        assert mine.similarity == pytest.approx(theirs.similarity, abs=1e-12)
    if (algorithm, action_range) == ("PPO", "unit"):  # the share is of its raw actions
        assert predicted.regions[0].clipped_share == 0
        assert 0.05 < own.regions[0].clipped_share < 0.95


def test_a_model_that_does_not_fit_is_refused(sb3):
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    ppo = untrained(sb3, "PPO")
    with pytest.raises(PolicyError, match=r"its observations have shape \(5,\): must be \(10,\)"):
        evaluate(ppo, "Default-v1", PROTOCOL)
    with pytest.raises(PolicyError, match=r"its actions have shape \(2,\): must be \(1,\)"):
        evaluate(ppo, SPEC.derive(action_dim=1), PROTOCOL)
    env = VecNormalize(DummyVecEnv([lambda: sme_registry.make(SPEC)]))
    with pytest.raises(PolicyError, match="VecNormalize"):
        evaluated(sb3.PPO("MlpPolicy", env, device="cpu"))
    wide = untrained(sb3, "PPO")
    wide.action_space = type(wide.action_space)(-2.0, 2.0, (2,))
    with pytest.raises(PolicyError, match=r"must be \[0, 1\] or \[-1, 1\] in every channel"):
        evaluated(wide)
    assert evaluated(wide, action_range="unit").action_range == "unit"


@pytest.fixture(scope="module")
def onnx():
    pytest.importorskip("onnxruntime")
    return pytest.importorskip("onnx")


def network(onnx, path, o=5, a=2, dtype="FLOAT", batch="batch", operator="MatMul"):
    """A linear policy's file, and its weights `[o, a]`."""
    W = np.random.default_rng(2).normal(scale=0.4, size=(o, a)).astype(np.float32)
    value, type = onnx.helper.make_tensor_value_info, getattr(onnx.TensorProto, dtype)
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node(operator, ["o", "W"], ["a"])],
        "policy",
        [value("o", type, [batch, o])],
        [value("a", type, [batch, a])],
        [onnx.numpy_helper.from_array(W.astype("f8") if dtype == "DOUBLE" else W, "W")],
    )
    opset = onnx.helper.make_opsetid("", 17)
    model = onnx.helper.make_model(graph, opset_imports=[opset], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return W


@pytest.mark.parametrize("action_range", [None, "unit", "symmetric"])
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_an_onnx_file_scores_as_its_network_in_numpy(onnx, tmp_path, action_range):
    W = network(onnx, tmp_path / "actor.onnx")
    report = evaluated(tmp_path / "actor.onnx", action_range=action_range)
    same = evaluated(lambda o: o @ W, action_range=action_range)
    assert (report.policy, report.action_range) == ("actor", action_range or "unit")
    assert "onnxruntime" in report.versions
    for mine, theirs in zip(report.regions, same.regions, strict=True):
        assert mine.similarity == pytest.approx(theirs.similarity, abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"o": 4}, r"its inputs are o tensor\(float\) \['batch', 4\]: must be .* \[batch, 5\]"),
        ({"a": 3}, r"its outputs are a tensor\(float\) \['batch', 3\]: must be .* \[batch, 2\]"),
        ({"batch": 1}, "the batch of any size"),
        ({"dtype": "DOUBLE"}, r"its inputs are o tensor\(double\)"),
        ({"operator": "Nonsense"}, "not a network that onnxruntime can load"),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else "",
)
def test_an_onnx_file_that_does_not_fit_is_refused(onnx, tmp_path, changes, message):
    network(onnx, tmp_path / "actor.onnx", **changes)
    with pytest.raises(PolicyError, match=message):
        evaluated(tmp_path / "actor.onnx")


def test_without_onnxruntime_an_onnx_file_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    (tmp_path / "actor.onnx").write_bytes(b"")
    with pytest.raises(MissingDependencyError, match=r"pip install .*\[onnx\]"):
        evaluated(tmp_path / "actor.onnx")


def test_onnx_files_play_as_a_team_apart_and_together(onnx, tmp_path):
    agents = [
        {"name": "left_0", "action_dim": 1, "observes": [0, 2]},
        {"name": "right_0", "action_dim": 3},
    ]
    team = SMESpec(state_dim=3, action_dim=4, team={"agents": agents})
    left = network(onnx, tmp_path / "left.onnx", o=4, a=1)
    right = network(onnx, tmp_path / "right.onnx", o=5, a=3)
    both = network(onnx, tmp_path / "both.onnx", o=7, a=3)
    files = {"left_0": tmp_path / "left.onnx", "right_0": tmp_path / "right.onnx"}
    functions = {"left_0": lambda o: o @ left, "right_0": lambda o: o @ right}
    for policy, same in ((files, functions), (tmp_path / "both.onnx", lambda o: o @ both)):
        mine, theirs = evaluate(policy, team, PROTOCOL), evaluate(same, team, PROTOCOL)
        assert mine.regions[0].similarity == pytest.approx(theirs.regions[0].similarity, abs=1e-6)
    (tmp_path / "apart").mkdir()
    for name, file in files.items():
        file.rename(tmp_path / "apart" / f"{name}.onnx")
    for folder in (tmp_path / "apart", str(tmp_path / "apart")):
        mine, theirs = evaluate(folder, team, PROTOCOL), evaluate(functions, team, PROTOCOL)
        assert mine.policy == "apart"
        assert mine.regions[0].similarity == pytest.approx(theirs.regions[0].similarity, abs=1e-6)
    files = {name: tmp_path / "apart" / f"{name}.onnx" for name in files}
    right = tmp_path / "apart" / "right_0.onnx"
    with pytest.raises(PolicyError, match=r"left_0: .*its inputs are .*5.*must be .*\[batch, 4\]"):
        evaluate({**files, "left_0": right}, team, PROTOCOL)


OWN = "def act(observations):\n    return observations[:, :2]\n"
OWN_MODULE = (
    "import torch\nactor = torch.nn.Linear(5, 2)\nact = lambda o: actor(torch.as_tensor(o))\n"
)
FORMS = ["linear", "agent.zip", "agent.onnx", "agent.npz", "own:act", "module:actor", "module:act"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_python_evaluates_everything_that_the_command_line_does(form, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if form == "agent.zip":
        untrained(pytest.importorskip("stable_baselines3"), "PPO").save(form)
    elif form == "agent.onnx":
        network(pytest.importorskip("onnx"), tmp_path / form)
    elif form == "agent.npz":
        weights = np.ones((2, 5), np.float32)
        OfflinePolicy([(weights, np.zeros(2, np.float32))]).save(form)
    elif form.startswith("module"):
        pytest.importorskip("torch")
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "module.py").write_text(OWN_MODULE)
    sme_registry.save(SPEC, "task.json", "Task")
    done = good("evaluate", form, "task.json", "--protocol", "quick-v1", "--json")
    assert evaluate(form, "task.json", "quick-v1").to_dict() == json.loads(done.stdout)
    for name in ("own", "module"):
        sys.modules.pop(name, None)


def torch_actor(torch):
    """A module with dropout, so that the mode matters, and gradients."""
    torch.manual_seed(0)
    nn = torch.nn
    return nn.Sequential(nn.Linear(5, 8), nn.Dropout(0.5), nn.Linear(8, 2), nn.Sigmoid())


def regrets(policy, **kw):
    return [region.normalised_regret for region in evaluated(policy, **kw).regions]


def test_modules_and_functions_of_pytorch_are_policies():
    torch = pytest.importorskip("torch")
    actor = torch_actor(torch).eval()

    def act(observations):
        with torch.no_grad():
            return actor(torch.from_numpy(observations)).numpy()

    expected = regrets(act)
    assert regrets(lambda o: actor(torch.from_numpy(o))) == expected  # with gradients
    assert regrets(lambda o: actor(torch.from_numpy(o)).detach()) == expected
    assert regrets(lambda o: actor(torch.from_numpy(o)).bfloat16()) == pytest.approx(
        expected, abs=0.01
    )
    actor.train()
    assert regrets(actor) == expected
    assert actor.training
    assert evaluated(actor).policy == "Sequential"
    assert regrets(actor.double()) == pytest.approx(expected, abs=1e-5)


def test_modules_and_functions_of_tensors_are_told_what_is_wrong():
    torch = pytest.importorskip("torch")

    class Actor(torch.nn.Module):
        def forward(self, x):
            return x, x

    message = r"'Actor': returns an object of type tuple.*\[0\]` for a tuple"
    with pytest.raises(PolicyError, match=message):
        evaluated(Actor())
    actor = torch_actor(torch)
    with pytest.raises(PolicyError, match=r"NumPy arrays: `torch\.as_tensor\(observations\)`"):
        evaluated(lambda o: actor(o))


@pytest.mark.parametrize(
    ("level", "action_range", "warned"), [(-0.5, None, 1), (-0.5, "unit", 0), (1.5, None, 0)]
)
def test_a_policy_whose_actions_are_mostly_below_0_is_warned_of_once(level, action_range, warned):
    def act(observations):
        return np.full((len(observations), 4), level)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sme_registry.evaluate(act, "Default", "quick-v1", action_range=action_range)
    assert ["symmetric" in str(warning.message) for warning in caught] == [True] * warned
