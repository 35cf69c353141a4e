"""Tasks whose agents do not see the state: sensitivity, two kinds of OOD, and linear probes."""

import numpy as np
import pytest

from sme_registry import evaluate, make, materialize
from sme_registry.evaluation import Perceptron, regions
from sme_registry.evaluation.regions import expansion, probe_layers
from sme_registry.spec import EvaluationProtocol
from sme_registry.task.certificate import held_out_r2
from tests.evaluation.kinds import DISTRACTED as SPEC
from tests.evaluation.kinds import DISTRACTORS as M
from tests.evaluation.kinds import distracted

S, A = SPEC.state_dim, SPEC.action_dim
MIXED = SPEC.derive(observation={"distractors": M, "mixing": "nonlinear", "mixing_depth": 2})
PROTOCOL = EvaluationProtocol(states_per_region=2_000, epsilons=(0.5, 1.0))


def ignorant(observations):
    return observations[:, :A]


@pytest.fixture(scope="module")
def report():
    return evaluate(distracted, SPEC, PROTOCOL)


def drawn(region, spec=SPEC):
    batches = list(regions.states(PROTOCOL, region, spec))
    s, d = (np.concatenate([getattr(batch, name) for batch in batches]) for name in "sd")
    return s.astype(np.float64), d


def test_the_agent_observes_state_and_distractors_and_the_time():
    shown = []
    evaluate(lambda o: shown.append(o) or ignorant(o), SPEC, PROTOCOL)
    first = shown[0]
    s, d = drawn(0)
    np.testing.assert_array_equal(first[:, :S], s.astype(np.float32))
    np.testing.assert_array_equal(first[:, S : S + M], d.astype(np.float32))
    assert first.dtype == np.float32
    assert first.shape[1] == SPEC.observation_dim
    assert set(np.round(first[:, -2] * SPEC.horizon, 4)) <= set(range(SPEC.horizon))
    assert (first[:, -1] == 0.0).all()


def test_states_are_those_of_the_task_without_distractors():
    plain = evaluate(ignorant, SPEC.derive(observation=None), PROTOCOL)
    seeing = evaluate(ignorant, SPEC, PROTOCOL)
    assert seeing.regions == plain.regions
    assert seeing.references == plain.references


@pytest.mark.parametrize("region", [0, 1, 2])
def test_distractors_are_uniform_in_the_cube_in_every_region_of_states(region):
    s, d = drawn(region)
    assert d.shape == (2_000, M)
    assert ((d > 0.0) & (d < 1.0)).all()
    assert d.mean(axis=0) == pytest.approx([0.5] * M, abs=0.03)
    assert abs(np.corrcoef(s.T, d.T)[:S, S:]).max() < 0.08


def test_sensitivity_is_that_of_the_definition(report):
    assert report.observation.probes == ()  # of an unknown network
    # a(s, d) − a(s, d') = 0.2 (d − d'), of which the mean absolute value is 0.2/3.
    task = materialize(SPEC)
    for region, each in enumerate(report.observation.sensitivity):
        half = np.abs(0.5 - task.optimal_action(drawn(region)[0])).mean()
        assert each.sensitivity == pytest.approx(0.2 / 3 / half, rel=0.03)


def test_distractors_outside_the_cube_leave_the_states_inside_and_are_scored_by_the_definition():
    shown = []
    report = evaluate(lambda o: shown.append(o) or distracted(o), SPEC, PROTOCOL)
    # In WD: the states, other distractors, and distractors in each of the shells.
    inside, other, *outside = (o[:, :-2] for o in shown[:4])
    np.testing.assert_array_equal(inside[:, :S], other[:, :S])
    assert (inside[:, S:] != other[:, S:]).all()
    optimal = materialize(SPEC).optimal_action(drawn(0)[0])
    half = np.abs(0.5 - optimal).mean()
    scores = report.observation.distractor_regions
    assert [region.name for region in scores] == ["d-OOD 1", "d-OOD 2"]
    for x, (low, high), score in zip(outside, PROTOCOL.edges[1:], scores, strict=True):
        np.testing.assert_array_equal(x[:, :S], inside[:, :S])
        E = expansion(x[:, S:].astype(np.float64))
        assert ((low < E) & (high >= E)).all()
        missed = np.abs(np.clip(distracted(x), 0.0, 1.0) - optimal).mean()
        assert score.mae == pytest.approx(missed, abs=1e-7)
        assert score.normalised_regret == pytest.approx(missed / half, abs=1e-6)


@pytest.mark.parametrize("mixing", ["none", "orthogonal", "nonlinear"])
def test_the_optimum_is_attainable_through_every_mixing(mixing):
    spec = SPEC.derive(observation={"distractors": M, "mixing": mixing})
    report = evaluate("optimal", spec, PROTOCOL)
    assert report.regions[0].normalised_regret < 1e-5
    assert report.observation.sensitivity[0].sensitivity < 1e-5
    assert max(region.normalised_regret for region in report.regions) < 1e-2


@pytest.mark.parametrize("depth", [1, 3])
def test_unmixing_inverts_what_the_agent_sees(depth):
    task = materialize(SPEC.derive(observation={"mixing": "nonlinear", "mixing_depth": depth}))
    s = np.random.default_rng(0).random((500, S))
    np.testing.assert_allclose(task.unmixed(task.seen(s)), s, atol=1e-9)
    np.testing.assert_allclose(task.unmixed(task.seen(s[0])), s[0], atol=1e-9)


def test_without_distractors_there_is_neither_sensitivity_nor_a_second_kind_of_ood():
    spec = SPEC.derive(observation={"mixing": "orthogonal"})
    report = evaluate(Perceptron([(np.ones((S + 2, A)), np.zeros(A), "identity")]), spec, PROTOCOL)
    assert report.observation.sensitivity == report.observation.distractor_regions == ()
    [probe] = report.observation.probes  # a linear map has no hidden layer
    assert (probe.layer, probe.units, probe.distractor_r2) == (0, S, None)
    assert probe.state_r2 == pytest.approx(1.0, abs=1e-9)


def network(W):
    """One hidden layer, which keeps a linear image of the observation, and an output."""
    output = np.full((W.shape[1], A), 0.1), np.zeros(A), "identity"
    return Perceptron([(W, np.zeros(W.shape[1]), "identity"), output])


def test_probes_find_what_a_layer_keeps_and_what_it_drops():
    keeps_state = np.zeros((S + M + 2, S))
    keeps_state[:S] = np.eye(S)
    keeps_half = np.zeros((S + M + 2, 2))
    keeps_half[:2] = np.eye(2)
    for W, state_r2 in ((keeps_state, 1.0), (keeps_half, 0.5)):
        observed, hidden = evaluate(network(W), SPEC, PROTOCOL).observation.probes
        assert (observed.layer, observed.units, hidden.layer) == (0, S + M, 1)
        assert hidden.units == W.shape[1]
        assert observed.state_r2 == pytest.approx(1.0, abs=1e-9)
        assert observed.distractor_r2 == pytest.approx(1.0, abs=1e-9)
        assert hidden.state_r2 == pytest.approx(state_r2, abs=0.01)
        assert hidden.distractor_r2 == pytest.approx(0.0, abs=0.01)


def test_probes_are_held_out():
    # 60 random units explain any target in 50 states, and nothing in the other 50.
    random = np.random.default_rng(0)
    r2 = held_out_r2(random.normal(size=(100, 60)), random.normal(size=(100, 8)))
    assert r2.shape == (8,)
    assert r2.mean() < 0.1


@pytest.mark.parametrize(
    ("distractors", "units", "layers"), [(508, 1, 2), (509, 1, 0), (M, 1024, 0)]
)
def test_probes_that_the_states_cannot_fit_are_left_out(distractors, units, layers, monkeypatch):
    # 512 channels in all is the most. With 1,024 units, an unknown has fewer than four states.
    monkeypatch.setattr(regions, "PROBE_STATES", 2**13)
    task = materialize(SPEC.derive(observation={"distractors": distractors}))
    probes = probe_layers(lambda o: [o[:, :1].repeat(units, axis=1)], task, PROTOCOL)
    assert [probe.layer for probe in probes] == list(range(layers))


def test_a_nonlinear_mixing_is_what_a_linear_map_cannot_undo():
    W = np.zeros((S + M + 2, 1))
    [seen, _] = evaluate(network(W), MIXED, PROTOCOL).observation.probes
    assert 0.85 < seen.state_r2 < 0.97
    assert 0.85 < seen.distractor_r2 < 0.97


def module(forward, *layers):
    """A PyTorch module of these layers, whose forward pass calls them as it likes."""
    torch = pytest.importorskip("torch")

    class Module(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = torch.nn.ModuleList(layers)

        def forward(self, o):
            return forward(o, *self.layers)

    return Module()


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_torch_modules_have_the_probes_of_their_layers():
    torch = pytest.importorskip("torch")
    Linear = torch.nn.Linear
    torch.manual_seed(0)
    first, second, mean = Linear(S + M + 2, 7), Linear(7, 6), Linear(6, A)

    def forward(o, first, second, mean, spread):
        h = torch.relu(second(torch.tanh(first(o))))
        return mean(h) + 0.0 * spread(h)

    chain = module(forward, first, second, mean, Linear(6, A))
    probes = evaluate(chain, SPEC, PROTOCOL).observation.probes
    assert [(probe.layer, probe.units) for probe in probes] == [(0, S + M), (1, 7), (2, 6)]
    arrays = [
        (layer.weight.T.detach().numpy(), layer.bias.detach().numpy(), activation)
        for layer, activation in ((first, "tanh"), (second, "relu"), (mean, "identity"))
    ]
    same = evaluate(Perceptron(arrays), SPEC, PROTOCOL).observation.probes
    for one, other in zip(probes, same, strict=True):
        assert one.state_r2 == pytest.approx(other.state_r2, abs=1e-5)
        assert one.distractor_r2 == pytest.approx(other.distractor_r2, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "widths"), [("PPO", [64, 64]), ("SAC", [256, 256]), ("TD3", [400, 300])]
)
@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_models_have_the_probes_of_their_layers(name, widths):
    sb3 = pytest.importorskip("stable_baselines3")
    action_range = "unit" if name == "PPO" else "symmetric"
    env = make(SPEC, action_range=action_range)
    model = getattr(sb3, name)("MlpPolicy", env, seed=0, device="cpu")
    probes = evaluate(model, SPEC, PROTOCOL).observation.probes
    assert [probe.units for probe in probes] == [S + M, *widths]
    assert all(-0.1 < probe.state_r2 <= 1.0 for probe in probes)


@pytest.mark.filterwarnings("ignore:.*actions below 0 are clipped")
def test_torch_modules_whose_linear_layers_form_no_chain_have_no_probes():
    torch = pytest.importorskip("torch")
    nn, entries = torch.nn, SPEC.observation_dim

    def mlp():
        return nn.Sequential(nn.Linear(entries, 8), nn.ReLU(), nn.Linear(8, A))

    def tokens(o, embed, head):  # each entry of the observation is a row
        return torch.sigmoid(head(embed(o[..., None]).flatten(1)))

    def rows(o, network):  # one call for each state
        return torch.stack([network(row) for row in o])

    def branches(o, one, other, head):  # the second one's input is no output of the first
        return head(torch.relu(torch.cat([one(o[:, :M]), other(o[:, M : 2 * M])], dim=1)))

    def towers(o, one, other):  # two networks side by side
        return one(o) + other(o)

    protocol = EvaluationProtocol(states_per_region=64, epsilons=(0.5,))
    for forward, *layers in (
        (tokens, nn.Linear(1, 4), nn.Linear(4 * entries, A)),
        (rows, mlp()),
        (branches, nn.Linear(M, M), nn.Linear(M, M), nn.Linear(2 * M, A)),
        (towers, mlp(), mlp()),
    ):
        policy = module(forward, *layers)
        assert evaluate(policy, SPEC, protocol).observation.probes == (), forward.__name__
