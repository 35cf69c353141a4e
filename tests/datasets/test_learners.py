"""The losses of BC and IQL against their equations, written out in NumPy row by row."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from sme_registry.datasets.documents import BCHyperparameters, IQLHyperparameters  # noqa: E402
from sme_registry.datasets.learners import BC, IQL, Minibatch, minibatches, mlp  # noqa: E402
from tests.datasets.sets import transitions_of  # noqa: E402

SEEN, A, B = 4, 2, 32


@pytest.fixture(autouse=True)
def _one_thread():
    """Networks this small are slower on more threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def batch():
    torch.manual_seed(1)
    u = torch.rand(B, A) * 2 - 1
    u[0], u[1] = 1.0, -1.0  # actions at the faces of the cube, where a tanh density ends
    continues = (torch.arange(B) % 4 != 0).float()[:, None]
    return Minibatch(torch.rand(B, SEEN), u, torch.rand(B, SEEN), torch.rand(B, 1), continues)


def asked(network, *inputs):
    with torch.no_grad():
        return network(torch.cat(inputs, dim=1)).double().numpy()


def test_the_loss_of_bc_is_the_mean_squared_error(batch):
    learner = BC(SEEN, A, BCHyperparameters(hidden=(8,)))
    u = np.tanh(asked(learner.actor, batch.observations))
    expected = ((u - batch.actions.numpy()) ** 2).mean()
    assert float(learner.losses(batch)["actor"].detach()) == pytest.approx(expected, rel=1e-6)


def test_the_losses_of_iql_are_its_equations(batch):
    learner = IQL(SEEN, A, IQLHyperparameters(hidden=(8,), expectile=0.8, inverse_temperature=2.0))
    with torch.no_grad():  # targets unlike the critics, as after many steps; advantages of a size
        for network in (*learner.targets, learner.value):
            for parameter in network.parameters():
                parameter.mul_(3.0)
        learner.spread += 0.3
    o, u, ahead, rewards, continues = batch
    q = np.minimum(*(asked(target, o, u) for target in learner.targets))
    d = q - asked(learner.value, o)
    assert (d < 0).any()
    assert (d > 0).any()
    value = np.mean(np.where(d < 0, 0.2, 0.8) * d**2)
    goal = rewards.numpy() + 0.99 * continues.numpy() * asked(learner.value, ahead)
    critic = sum(np.mean((asked(each, o, u) - goal) ** 2) for each in learner.critics)
    sigma = np.exp(-5.0 + 7.0 / (1.0 + np.exp(-0.3)))
    z = (u.numpy() - np.tanh(asked(learner.actor, o))) / sigma
    density = (-0.5 * z**2 - np.log(sigma) - 0.5 * np.log(2 * np.pi)).sum(axis=1, keepdims=True)
    actor = np.mean(-np.exp(2.0 * d) * density)
    found = {name: float(loss.detach()) for name, loss in learner.losses(batch).items()}
    assert found == pytest.approx({"value": value, "critic": critic, "actor": actor}, rel=1e-5)


def test_the_weight_of_an_advantage_is_limited(batch):
    free = IQL(SEEN, A, IQLHyperparameters(hidden=(8,), inverse_temperature=1000.0, max_weight=1e6))
    cut = IQL(SEEN, A, IQLHyperparameters(hidden=(8,), inverse_temperature=1000.0, max_weight=2.0))
    for learner in (free, cut):
        with torch.no_grad():
            for parameter in learner.value.parameters():
                parameter.zero_()
            learner.value[-1].bias -= 100.0  # every advantage is large
    cloned = IQL(SEEN, A, IQLHyperparameters(hidden=(8,), inverse_temperature=0.0))
    for learner in (cut, cloned):
        learner.actor.load_state_dict(free.actor.state_dict())
    losses = [float(x.losses(batch)["actor"].detach()) for x in (free, cut, cloned)]
    assert losses == pytest.approx([1e6 * losses[2], 2.0 * losses[2], losses[2]], rel=1e-5)


def test_each_loss_trains_only_its_own_networks(batch):
    learner = IQL(SEEN, A, IQLHyperparameters(hidden=(8,)))
    parts = {
        "actor": [*learner.actor.parameters(), learner.spread],
        "critic": list(learner.critics.parameters()),
        "value": list(learner.value.parameters()),
    }
    everything = [parameter for part in parts.values() for parameter in part]
    for name, own in parts.items():
        loss = learner.losses(batch)[name]
        gradients = torch.autograd.grad(loss, everything, allow_unused=True)
        reached = {id(p) for p, g in zip(everything, gradients, strict=True) if g is not None}
        assert reached == {id(parameter) for parameter in own}


def test_targets_follow_the_critics_by_their_rate(batch):
    learner = IQL(SEEN, A, IQLHyperparameters(hidden=(8,), target_rate=0.25))
    before = [parameter.clone() for parameter in learner.targets.parameters()]
    learner.step(batch)
    pairs = zip(before, learner.critics.parameters(), learner.targets.parameters(), strict=True)
    for old, followed, now in pairs:
        torch.testing.assert_close(now, 0.75 * old + 0.25 * followed)
        assert not now.requires_grad


def test_bc_learns_a_function_that_it_can_represent():
    torch.manual_seed(0)
    truth = mlp(SEEN, (4,), A)
    learner = BC(SEEN, A, BCHyperparameters(hidden=(32,), learning_rate=0.01))
    observations = torch.rand(256, SEEN)
    with torch.no_grad():
        u = torch.tanh(truth(observations))
    batch = Minibatch(observations, u, observations, torch.zeros(256, 1), torch.ones(256, 1))
    first = float(learner.step(batch)["actor"].detach())
    for _ in range(200):
        last = float(learner.step(batch)["actor"].detach())
    assert last < 0.02 * first


def test_batches_have_matching_rows_of_all_columns_and_every_row_once_before_any_repeats():
    transitions = transitions_of(count=50)
    batches = minibatches(transitions, 20, torch.Generator().manual_seed(0))
    batch = Minibatch(*map(torch.cat, zip(*(next(batches) for _ in range(5)), strict=True)))
    rows = {row.tobytes(): index for index, row in enumerate(transitions.observations)}
    at = [rows[row.numpy().tobytes()] for row in batch.observations]
    assert sorted(at[:50]) == sorted(at[50:]) == list(range(50))
    assert at[:50] != at[50:]
    np.testing.assert_allclose((batch.actions.numpy() + 1) / 2, transitions.actions[at], atol=6e-8)
    np.testing.assert_array_equal(batch.next_observations, transitions.next_observations[at])
    np.testing.assert_allclose(batch.rewards[:, 0], transitions.rewards[at], rtol=1e-6)
    np.testing.assert_array_equal(batch.continues[:, 0], 1.0 - transitions.terminations[at])
    assert transitions.timeouts.any()
    assert (batch.continues == 1).all()  # D = 0: nothing terminates, and timeouts do not
