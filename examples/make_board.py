"""Make a leaderboard: the small one in `examples/board`, or one from your own training runs.

    pip install '.[leaderboard]'
    python examples/make_board.py --out examples/board       # small: about a minute, no PyTorch
    python examples/make_board.py --out board --suite smoke-v1 --protocol paper-v1 \
        --runs PPO runs/ppo --runs TD3 runs/td3

Without `--runs` it trains two linear policies in NumPy, ten runs each, on two instances of a task
with two state channels and two action channels:

    a = clip(x W + c, 0, 1)

Random search draws policies around the constant one and keeps the best. Hill climbing perturbs the
best policy so far and keeps each improvement. Both see rewards only. With `--runs` it submits the
runs in a folder of `sme train` or `sme study run`, or in a table of runs (`runs.json`).

The board's private key is deleted at the end, so that the folder can be published. `--keep-key`
keeps it, and the board can grow.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

import sme_registry
from leaderboard.admission import submit_bundle, submit_references
from leaderboard.bundle import make_bundle
from leaderboard.documents.signed import Receiver, SigningKey
from leaderboard.documents.submission import Description, Training
from leaderboard.scoring.verify import verify
from leaderboard.scoring.worker import run_scorers
from leaderboard.store import Store
from sme_registry.errors import SMEError
from sme_registry.spec import EvaluationProtocol, ProtocolFile, Suite, SuiteFile, catalogue

SETTING = {"state_dim": 2, "action_dim": 2, "policy_init": "unit_variance"}
INSTANCES = [3, 4]  # seeds of the tasks
SEEDS, POLICIES, ENVS = 5, 300, 8
METHODS = {"Random search": False, "Hill climbing": True}  # whether it moves to the best policy


def small_suite() -> SuiteFile:
    """One class of two instances."""
    suite = Suite.from_dict(
        {"classes": [{"name": "plane", "setting": SETTING, "seeds": INSTANCES}]}
    )
    return SuiteFile(name="example", version=1, digest=suite.digest, suite=suite)


def train(spec: sme_registry.SMESpec, seed: int, climb: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """Search for a linear policy by its mean reward over one episode in each of `ENVS` copies.

    Args:
      spec: the task.
      seed: of the search.
      climb: perturb the best policy so far, not the constant one.

    Returns:
      `W [S + 2, A]`, `c [A]` and the number of environment steps.
    """
    rng = np.random.default_rng(seed)
    env = sme_registry.make_vec(spec, num_envs=ENVS)
    constant = np.zeros((spec.state_dim + 3, spec.action_dim))
    constant[-1] = 0.5
    best, best_reward = constant, -np.inf
    for _ in range(POLICIES):
        weights = (best if climb else constant) + 0.2 * rng.normal(size=constant.shape)
        observations, _ = env.reset(seed=seed)
        reward = 0.0
        for _ in range(spec.horizon):
            actions = np.clip(observations @ weights[:-1] + weights[-1], 0.0, 1.0)
            observations, rewards, *_ = env.step(actions.astype(np.float32))
            reward += float(rewards.mean())
        if reward > best_reward:
            best, best_reward = weights, reward
    env.close()
    return best[:-1], best[-1], POLICIES * ENVS * spec.horizon


def linear_onnx(W: np.ndarray, c: np.ndarray) -> bytes:
    """The linear policy as an ONNX file."""
    interface = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])
        for name, width in zip(("observations", "actions"), W.shape, strict=True)
    ]
    numbers = {"W": W, "c": c, "low": np.array(0.0), "high": np.array(1.0)}
    graph = helper.make_graph(
        [
            helper.make_node("Gemm", ["observations", "W", "c"], ["y"]),
            helper.make_node("Clip", ["y", "low", "high"], ["actions"]),
        ],
        "policy",
        interface[:1],
        interface[1:],
        [numpy_helper.from_array(each.astype(np.float32), name) for name, each in numbers.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def train_all(folder: Path, suite: SuiteFile, method: str) -> Path:
    """Train a method on every instance; write the policies and the table of runs."""
    folder.mkdir(parents=True)
    rows = []
    for spec in suite.suite.instances:
        for seed in range(SEEDS):
            W, c, steps = train(spec, seed, METHODS[method])
            policy = folder / f"{spec.seed}-{seed}.onnx"
            policy.write_bytes(linear_onnx(W, c))
            rows.append({"spec": spec.digest, "policy": policy.name, "steps": steps, "seed": seed})
    table = folder / "runs.json"
    table.write_text(json.dumps(rows), encoding="utf-8")
    return table


def make_board(
    out: Path,
    suite: SuiteFile,
    protocol_name: str,
    protocol: EvaluationProtocol,
    runs: dict[str, Path] | None,
    submitter: str,
) -> None:
    """Create a board, submit the reference rows and every method, score them, and verify it."""
    with (
        tempfile.TemporaryDirectory() as temporary,
        Store.create(
            out,
            title=f"SME leaderboard: {suite.versioned_name}",
            suite_name=suite.versioned_name,
            suite=suite.suite,
            protocol_name=protocol_name,
            protocol=protocol,
        ) as store,
    ):
        submit_references(store)
        key = SigningKey.generate()
        for index, method in enumerate(runs or METHODS):
            print(f"{method} …", file=sys.stderr, flush=True)
            source = runs[method] if runs else train_all(Path(temporary, method), suite, method)
            make_bundle(
                Path(temporary, f"bundle-{index}"),
                Description(method, submitter),
                suite=suite,
                key=key,
                receiver=Receiver(store.document.key),
                runs=[source],
                training=None if runs else Training(library=f"numpy {np.__version__}"),
            )
            submit_bundle(store, Path(temporary, f"bundle-{index}"))
    run_scorers(out, 2)
    assert verify(out).is_confirmed


def main() -> None:
    """Read the arguments and make the board."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="a folder that does not exist yet")
    parser.add_argument("--runs", nargs=2, action="append", metavar=("METHOD", "PATH"))
    parser.add_argument("--suite", default="smoke-v1", help="of --runs (default: smoke-v1)")
    parser.add_argument("--protocol", default="paper-v1", help="of --runs (default: paper-v1)")
    parser.add_argument("--submitter", default="SME Registry", help="as the board shows it")
    parser.add_argument("--keep-key", action="store_true", help="keep the board's private key")
    options = parser.parse_args()
    if options.runs:
        protocol = catalogue.find(ProtocolFile, options.protocol)
        make_board(
            options.out,
            catalogue.find(SuiteFile, options.suite),
            protocol.versioned_name,
            protocol.protocol,
            {method: Path(path) for method, path in options.runs},
            options.submitter,
        )
    else:
        protocol = EvaluationProtocol(states_per_region=2000)
        make_board(options.out, small_suite(), "example-v1", protocol, None, options.submitter)
    if not options.keep_key:
        (options.out / "board.key").unlink()
    for path in options.out.glob("index.sqlite*"):
        path.unlink()
    print(f"{options.out}: scored and verified.")


if __name__ == "__main__":
    try:
        main()
    except SMEError as error:
        sys.exit(str(error))
