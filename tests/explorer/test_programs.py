"""Programs compute what the task and the policies compute, and nothing that they do not know."""

import numpy as np
import pytest

from sme_registry import SMESpec, export_onnx, load, make, materialize
from sme_registry.diagnosis import load_policy
from sme_registry.errors import ResourceLimitError
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.references import reference_policy
from sme_registry.explorer import policies, program
from sme_registry.explorer.policies import GraphNode, program_of_graph
from sme_registry.explorer.program import MAX_WEIGHTS, MAX_WIDTH, NetworkProgram
from tests.explorer.networks import arrays, observations, offline, perceptron

SPEC = SMESpec(state_dim=3, action_dim=2)
TASKS = ["Default", "Complexity50", "Safety20", "MixedLinear", "HardSafeMixed", "TeamBlind4"]


def points(spec, rows=64):
    return 2.0 * np.random.default_rng(3).random((rows, program.point_width(spec))) - 0.5


@pytest.mark.parametrize("name", TASKS)
def test_the_optimum_and_the_limits_are_the_tasks_own(name):
    task = materialize(load(name, SMESpec))
    x = points(task.spec)
    s = x[:, : task.spec.state_dim]
    np.testing.assert_allclose(program.optimal(task)(x), task.optimal_action(s), atol=1e-12)
    limit = program.limit(task)
    if task.spec.safety is None:
        assert limit is None
    else:
        assert limit is not None
        np.testing.assert_allclose(limit(x), task.limit(s), atol=1e-12)


@pytest.mark.parametrize("name", ["Default", "MixedLinear", "HardSafeMixed", "Distract8Noise"])
def test_a_policy_sees_what_the_task_shows(name):
    task = materialize(load(name, SMESpec))
    x = points(task.spec)
    seen = program.observe(task)(x)
    np.testing.assert_allclose(seen, observations(task.spec, x), atol=1e-6)
    assert np.array_equal(seen, seen.astype(np.float32))


def program_of(policy, **options):
    return policies.policy_program(load_policy(policy, SPEC, **options).policy, SPEC)


def same_actions(prepared, spec=SPEC):
    """The program of a policy acts as the policy."""
    program = policies.policy_program(prepared, spec)
    assert program is not None
    seen = points(spec).astype(np.float32)
    expected = np.clip(prepared(seen), 0.0, 1.0)
    assert expected.std() > 0.05  # no constant
    np.testing.assert_allclose(np.clip(program(seen), 0.0, 1.0), expected, atol=policies.TOLERANCE)


def known(policy, **options):
    same_actions(load_policy(policy, SPEC, **options).policy)


@pytest.mark.parametrize("action_range", ["unit", "symmetric"])
@pytest.mark.parametrize("activation", ["identity", "relu", "tanh", "sigmoid", "silu", "elu"])
def test_arrays_are_known(activation, action_range):
    policy = perceptron(SPEC, activation, squashed=action_range == "symmetric")
    known(policy, action_range=action_range)


def test_an_offline_policy_is_known():
    known(offline(SPEC))


@pytest.mark.parametrize("name", ["PPO", "SAC", "TD3"])
def test_models_of_stable_baselines3_are_known(name, tmp_path):
    sb3 = pytest.importorskip("stable_baselines3")
    model = getattr(sb3, name)("MlpPolicy", make(SPEC, action_range="symmetric"), seed=0)
    shake(model.policy)
    model.save(tmp_path / "model.zip")
    known(tmp_path / "model.zip")


@pytest.mark.parametrize("kind", ["perceptron", "module", "normalised"])
def test_pytorch_modules_and_onnx_files_are_known(kind, tmp_path):
    pytest.importorskip("onnxruntime")
    if kind == "perceptron":
        policy = perceptron(SPEC, "silu")
    else:
        policy = module(SPEC, kind)
        known(policy)
    known(export_onnx(policy, SPEC, tmp_path / "actor.onnx"))


def module(spec, kind):
    torch = pytest.importorskip("torch")
    nn = torch.nn
    torch.manual_seed(0)
    n, A = spec.observation_dim, spec.action_dim
    norm = [nn.LayerNorm(16)] if kind == "normalised" else []
    made = nn.Sequential(
        nn.Linear(n, 16), *norm, nn.SiLU(), nn.Linear(16, 16), nn.LeakyReLU(), nn.Linear(16, A),
        nn.Sigmoid(),
    )  # fmt: skip
    shake(made)
    return made


def shake(network):
    """A fresh network acts almost constantly."""
    import torch

    torch.manual_seed(1)
    for parameter in network.parameters():
        parameter.data += 0.4 * torch.randn_like(parameter)


def test_a_function_is_unknown_and_so_is_what_its_layers_do_not_say():
    class Different(type(perceptron(SPEC))):
        def __call__(self, o):
            return 1.0 - super().__call__(o)

    linear = reference_policy("linear", SPEC)
    for policy in (lambda o: np.sin(o[:, :2]), linear, Different(perceptron(SPEC).layers)):
        assert program_of(policy) is None


@pytest.mark.parametrize("name", ["Team2", "TeamBlind4"])
@pytest.mark.parametrize("shared", [True, False])
def test_teams_are_known(name, shared):
    spec = load(name, SMESpec)
    agents, S = spec.team.agents, spec.state_dim
    if shared:
        policy = perceptron(SMESpec(state_dim=S + len(agents), action_dim=2))
    else:
        policy = {}
        for index, agent in enumerate(agents):
            width = S if agent.observes == "all" else len(agent.observes)
            shape = SMESpec(state_dim=width, action_dim=agent.action_dim, seed=index)
            policy[agent.name] = perceptron(shape, ["tanh", "relu"][index % 2])
    same_actions(as_policy(policy, spec), spec)


def graph(*nodes, **constants):
    return program_of_graph(nodes, constants, "o", "a", 5)


DENSE = GraphNode("Gemm", ("o", "W", "b"), ("a",), {"transB": 1})


def test_a_graph_is_understood_in_full_or_not_at_all():
    W, b, x = arrays(2, 5), arrays(2), arrays(7, 5)
    program = graph(DENSE, W=W, b=b)
    np.testing.assert_allclose(program(x), x @ W.T + b, rtol=1e-6)
    clipped = GraphNode("Clip", ("h", "", "most"), ("a",), {})
    first = DENSE._replace(outputs=("h",))
    program = graph(first, clipped, W=W, b=b, most=np.float32(0.1))
    np.testing.assert_allclose(program(x), np.minimum(x @ W.T + b, 0.1), rtol=1e-6)
    for wrong in (
        [DENSE._replace(operator="Conv")],
        [DENSE._replace(attributes={"transA": 1, "transB": 1})],
        [DENSE._replace(attributes={})],  # W would be [5, 2]
        [DENSE._replace(inputs=("o", "missing", "b"))],
        [first, GraphNode("Softmax", ("h",), ("a",), {"axis": 0})],
        [first, GraphNode("Concat", ("h", "o"), ("a",), {"axis": 0})],
        [first, GraphNode("Cast", ("h",), ("a",), {"to": 6})],
        [first, GraphNode("Reshape", ("h", "shape"), ("a",), {})],
        [first],  # no output
    ):
        assert graph(*wrong, W=W, b=b, shape=np.array([2, -1])) is None
    assert graph(DENSE, W=np.full((2, 5), np.nan, np.float32), b=b) is None


def test_a_graph_cannot_grow_without_end():
    doubled = [
        GraphNode("Concat", (f"x{i}", f"x{i}"), (f"x{i + 1}",), {"axis": 1}) for i in range(40)
    ]
    start = GraphNode("Identity", ("o",), ("x0",), {})
    assert graph(start, *doubled, GraphNode("Identity", ("x40",), ("a",), {})) is None


def test_a_network_too_large_for_a_page_is_refused():
    wide = NetworkProgram(3, "this")
    W = np.zeros((8, MAX_WEIGHTS // 16))
    wide.dense(0, W, np.zeros(8))
    with pytest.raises(ResourceLimitError, match=f"this: has more than {MAX_WEIGHTS:,}"):
        wide.dense(0, W, np.zeros(8))
    with pytest.raises(ResourceLimitError, match="too large for a page"):
        NetworkProgram(3).constant(np.zeros(MAX_WIDTH + 1))
    with pytest.raises(ValueError, match="widths"):
        NetworkProgram(3).binary("add", 0, np.zeros(2))
