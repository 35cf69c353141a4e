"""Train a team with TorchRL, and print the exact regret of each agent.

    pip install torchrl '.[fast]'
    python examples/torchrl_team.py --env Team4 --seeds 0

`make_parallel` returns a PettingZoo environment, which TorchRL's `PettingZooWrapper` accepts
directly. The rest is TorchRL's multi-agent PPO: an actor for each agent, critics that see all
observations (MAPPO), a collector and a loss. Two details are specific to these tasks:

- Each agent has its own network (`share_params=False`). In Team4 all agents have the same
  observations and different optimal actions, so a shared network would also need the agent's index.
- The regret printed is that of the agent's own channels, even if the team shares one reward.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings

import numpy as np

import sme_registry

try:
    import torch
    from tensordict import TensorDict
    from tensordict.nn import TensorDictModule
    from tensordict.nn.distributions import NormalParamExtractor
    from torchrl.collectors import Collector
    from torchrl.envs import ExplorationType, SerialEnv, set_exploration_type
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper
    from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
    from torchrl.objectives import ClipPPOLoss, ValueEstimators
except ModuleNotFoundError as error:
    missing = error.name
else:
    missing = None

ENVS, ROLLOUT, EPOCHS, MINIBATCH = 8, 128, 10, 256
GROUP = "team"  # the wrapper stacks the agents of a group, [..., agent, channel]


def make(spec: sme_registry.SMESpec) -> PettingZooWrapper:
    """The team as a TorchRL environment, with its agents stacked in one group."""
    team = sme_registry.make_parallel(spec)
    return PettingZooWrapper(team, group_map={GROUP: team.possible_agents})


def regret(task: sme_registry.Task, steps: TensorDict) -> np.ndarray:
    """Mean regret `[n]` in [0, 1] of each agent on its own channels."""
    similarities = steps["next", GROUP, "info", "similarity"].flatten(0, -2).numpy()
    return (1.0 - task.reward_of(similarities)).mean(axis=0)


def networks(
    task: sme_registry.Task, envs: SerialEnv
) -> tuple[ProbabilisticActor, TensorDictModule]:
    """An actor for each agent on its observation, and a critic on all observations."""
    sizes = {"n_agents": len(task.names), "share_params": False, "num_cells": 64, "depth": 2}
    inputs, outputs = len(task.observed[0]) + 2, task.owned[0].stop
    actor = ProbabilisticActor(
        TensorDictModule(
            torch.nn.Sequential(
                MultiAgentMLP(inputs, 2 * outputs, centralized=False, **sizes),
                NormalParamExtractor(),
            ),
            in_keys=[(GROUP, "observation")],
            out_keys=[(GROUP, "loc"), (GROUP, "scale")],
        ),
        spec=envs.action_spec_unbatched,
        in_keys=[(GROUP, "loc"), (GROUP, "scale")],
        out_keys=[(GROUP, "action")],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": 0.0, "high": 1.0},  # the environment's action range
        return_log_prob=True,
    )
    critic = TensorDictModule(
        MultiAgentMLP(inputs, 1, centralized=True, **sizes),
        in_keys=[(GROUP, "observation")],
        out_keys=[(GROUP, "state_value")],
    )
    return actor, critic


def train(spec: sme_registry.SMESpec, seed: int, steps: int) -> None:
    """Train for a number of team steps; print each agent's regret before, during and after."""
    torch.manual_seed(seed)
    task = sme_registry.materialize(spec)
    envs, evaluation_envs = (SerialEnv(ENVS, lambda: make(spec)) for _ in range(2))
    envs.set_seed(seed)
    actor, critic = networks(task, envs)
    loss = ClipPPOLoss(
        actor,
        critic,
        entropy_coeff=0.0,
        normalize_advantage=True,
        normalize_advantage_exclude_dims=(-2,),  # for each agent separately
    )
    loss.set_keys(
        **{key: (GROUP, key) for key in ("reward", "action", "done", "terminated")},
        value=(GROUP, "state_value"),
        sample_log_prob=(GROUP, "action_log_prob"),
    )
    # With k = 1 and D = 0 the optimum earns 1 in every state, so a short horizon is enough: the
    # reward of a step measures its action. Larger k or D need a longer horizon.
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.5, lmbda=0.9)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)

    def print_row(label: str, steps_taken: TensorDict) -> None:
        values = regret(task, steps_taken)
        print(f"{label:>20}" + "".join(f"{value:10.3f}" for value in values), flush=True)

    def episodes_of_mean_actions() -> TensorDict:
        evaluation_envs.set_seed(seed)  # always from the same states
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return evaluation_envs.rollout(spec.horizon, actor)

    print(f"seed {seed}: regret of each agent, 0 at its optimum")
    print(f"{'team steps':>20}" + "".join(f"{name:>10}" for name in task.names))
    print_row("0, mean actions", episodes_of_mean_actions())
    start, done = time.perf_counter(), 0
    batches = max(1, steps // (ENVS * ROLLOUT))
    collector = Collector(
        envs,
        actor,
        frames_per_batch=ENVS * ROLLOUT,
        total_frames=batches * ENVS * ROLLOUT,
        auto_register_policy_transforms=False,  # no recurrent networks
    )
    for batch in collector:
        with torch.no_grad():
            loss.value_estimator(batch)
        flat = batch.reshape(-1)
        for _ in range(EPOCHS):
            for indices in torch.randperm(len(flat)).split(MINIBATCH):
                losses = loss(flat[indices])
                optimiser.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimiser.step()
        done += len(flat)
        print_row(f"{done}, exploring", batch)
    seconds = time.perf_counter() - start
    print_row(f"{done}, mean actions", episodes_of_mean_actions())
    evaluation_envs.close()
    print(f"{seconds:.0f} s, {done / seconds:.0f} team steps per second, training included\n")


def main() -> None:
    """Run the example from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="Team4", help="a team: an id, a path or a digest")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="one training for each")
    parser.add_argument("--steps", type=int, default=10_240, help="team steps of each training")
    arguments = parser.parse_args()
    if arguments.steps < 1 or min(arguments.seeds) < 0:
        parser.error("--steps must be at least 1, and --seeds 0 or more.")
    if missing is not None:
        parser.error(f"the module {missing} is not installed. Run `pip install torchrl`.")
    try:
        spec = sme_registry.load(arguments.env)
        task = sme_registry.materialize(spec)
    except sme_registry.SMEError as error:
        parser.error(str(error))
    observed = {len(channels) for channels in task.observed}
    owned = {own.stop - own.start for own in task.owned}
    if len(observed) > 1 or len(owned) > 1:
        parser.error(
            f"--env {arguments.env}: its agents observe or own different numbers of channels, "
            "so they cannot be stacked. Use one group for each agent "
            "(MarlGroupMapType.ONE_GROUP_PER_AGENT)."
        )
    warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested using version")
    torch.set_num_threads(1)  # networks this small are slower on several threads
    for seed in arguments.seeds:
        train(spec, seed, arguments.steps)


if __name__ == "__main__":
    sys.exit(main())
