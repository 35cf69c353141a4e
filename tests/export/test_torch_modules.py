"""PyTorch networks as people write them, exported."""

import numpy as np
import pytest

from sme_registry import export_onnx
from sme_registry.evaluation.models import start_session
from tests.export.test_export import SPEC, refused, same

torch = pytest.importorskip("torch")
nn = torch.nn


class Squashed(nn.Module):
    """An actor as of TD3, with actions in [−1, 1]."""

    def __init__(self):
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(5, 16), nn.Linear(16, 2)

    def forward(self, x):
        return torch.tanh(self.fc2(nn.functional.relu(self.fc1(x))))


class Residual(nn.Module):
    """Blocks with layer normalisation, GELU, dropout and skip connections."""

    def __init__(self):
        super().__init__()
        self.first, self.last = nn.Linear(5, 16), nn.Linear(16, 2)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(16), nn.Linear(16, 16), nn.GELU(), nn.Dropout(0.5))
            for _ in range(3)
        )

    def forward(self, x):
        x = self.first(x)
        for block in self.blocks:
            x = x + block(x)
        return torch.sigmoid(self.last(x))


class Gaussian(nn.Module):
    """An actor as of PPO: a distribution around its mean."""

    def __init__(self):
        super().__init__()
        self.mean, self.log_sd = nn.Linear(5, 2), nn.Parameter(torch.zeros(2))

    def forward(self, x):
        return torch.distributions.Normal(self.mean(x), self.log_sd.exp())

    def act(self, x):
        return self(x).mean


class Agent:
    def __init__(self):
        self.actor = Squashed()

    def act(self, x):
        return self.actor(x)


def made(name):
    torch.manual_seed(3)
    gaussian, agent, net = Gaussian(), Agent(), nn.Linear(5, 12)
    policies = {
        "sequential": (nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 2)), "symmetric"),
        "residual": (Residual(), "unit"),
        "double": (Squashed().double(), "symmetric"),
        "batch norm": (nn.Sequential(nn.Linear(5, 8), nn.BatchNorm1d(8), nn.Linear(8, 2)), "unit"),
        "method": (gaussian.act, "unit"),
        "lambda of an agent": (lambda x: agent.act(x)[:, :2], "symmetric"),
        "no parameters": (lambda x: x[:, :2], "unit"),
        # Networks that PyTorch writes with shape arithmetic, although only the batch size varies.
        "chunk": (lambda x: net(x).chunk(6, -1)[0], "unit"),
        "view": (lambda x: net(x).view(x.shape[0], -1)[:, :2], "unit"),
        "reshape": (lambda x: net(x).reshape(x.size(0), 3, -1).mean(1)[:, :2], "unit"),
        "unflatten": (lambda x: net(x).unflatten(1, (3, 4)).flatten(1)[:, :2], "unit"),
        "ones": (lambda x: net(x)[:, :2] + torch.ones(x.shape[0], 2) * 0.1, "unit"),
        "where": (lambda x: torch.where(x > 0.5, x, torch.zeros_like(x))[:, :2], "unit"),
        "moments": (
            lambda x: ((x - x.mean(1, keepdim=True)) / x.std(1, keepdim=True))[:, :2],
            "unit",
        ),
        "arange": (lambda x: x[:, :2] * torch.arange(x.shape[1])[1:3], "unit"),
    }
    return policies[name]


NAMES = (
    "sequential", "residual", "double", "batch norm", "method", "lambda of an agent",
    "no parameters", "chunk", "view", "reshape", "unflatten", "ones", "where", "moments", "arange",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_network_acts_as_before(name, tmp_path):
    policy, action_range = made(name)
    modes = [part.training for part in policy.modules()] if isinstance(policy, nn.Module) else []
    path = export_onnx(policy, SPEC, tmp_path / "policy.onnx", action_range=action_range)
    if modes:
        assert [part.training for part in policy.modules()] == modes
        policy.eval()

    def act(observations):
        with torch.no_grad():
            x = torch.from_numpy(observations)
            return policy(x.double() if name == "double" else x).numpy()

    same(policy, path, action_range, act)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (Gaussian(), r"returns an object of type Normal .*lambda o: actor\(o\)\.mean"),
        (lambda x: (x[:, :2], x), r"returns an object of type tuple .*lambda o: actor\(o\)\[0\]"),
        (lambda x: x[:, 0], r"returns a tensor \[3\] .*must be one PyTorch tensor \[3, 2\]"),
        (nn.Linear(4, 2), "fails on a PyTorch tensor"),
        (lambda o: np.tanh(o @ np.ones((5, 2))), r"fails on a PyTorch tensor.*`Perceptron`"),
        (lambda o: np.asarray(o)[:, :2], r"type ndarray .*`Perceptron` of arrays"),
        (lambda x: torch.rand_like(x[:, :2]), "differs from its own actions"),
        (lambda x: x[:, :2] * (1.0 if x.sum() > 3.0 else 0.5), "differs from its own actions"),
        (lambda x: torch.linalg.svd(x[:, :2])[0][:, :2], r"fails|cannot export|returns"),
    ],
)
def test_what_cannot_be_exported_is_refused(policy, message, tmp_path):
    refused(policy, tmp_path, message)


class Recurrent(nn.Module):
    def __init__(self):
        super().__init__()
        self.gru = nn.GRU(5, 2, batch_first=True)

    def forward(self, x):
        return self.gru(x[:, None])[0][:, 0]


@pytest.mark.parametrize(
    ("policy", "operator"),
    [
        (Recurrent(), "GRU"),
        (lambda x: torch.cat([x, torch.zeros(x.shape[0], 1)], 1)[:, 4:6], "ConstantOfShape"),
        (lambda x: x.repeat(1, 2)[:, 4:6], "Tile"),
    ],
)
def test_a_file_that_no_board_accepts_is_written_with_a_warning(policy, operator, tmp_path):
    message = (
        rf"policy\.onnx: has the operators .*{operator}.*boards do not accept.*`split\(n, -1\)`"
    )
    with pytest.warns(UserWarning, match=message):
        path = export_onnx(policy, SPEC, tmp_path / "policy.onnx")
    observations = np.random.default_rng(1).random((7, 5), dtype=np.float32)
    with torch.no_grad():
        expected = policy(torch.from_numpy(observations)).clamp(0.0, 1.0).numpy()
    actions = start_session(path).run(None, {"observations": observations})[0]
    np.testing.assert_allclose(actions, expected, atol=1e-6)


def test_a_length_that_tracing_fixes_is_named(tmp_path):
    refused(lambda x: x[:, :4].view(len(x), 2, 2)[:, 0], tmp_path, r"`x\.shape\[0\]` or -1")
