"""A player that knows the family: it fits networks built as optima are built.

    sme-leaderboard ticket URL winter --method F --submitter ME --knowledge family --out family.json
    python examples/season/family.py online URL family.json --out runs/family

    python examples/season/family.py offline autumn --out runs/family
    sme-leaderboard enter URL autumn 'runs/family/{name}.npy' --method F --submitter ME \\
        --knowledge family

Whoever knows how SMEs are built knows the optimum's form, and what a reward says of it:

    π*(s) = Φ(W_L Φ(… Φ(W_1 s + b_1) …) + b_L),   b_l = −½ W_l 1,   W_l = √12 · semi-orthogonal
    d     = mean_i |a_i − π*_i(s)| = (1 − r) / 4 where r > 0,   d ≥ ¼ where r = 0

Rewards measure the distance to the optimum without noise, so gradient descent can fit a network of
this form to them. If the player is killed, start it again: it goes on with the rows that it has.
`N` rows, `S` state channels, `A` action channels.
"""

from __future__ import annotations

import argparse
import itertools
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from sme_registry import seasons
from sme_registry.datasets import SealedDataset
from sme_registry.errors import OptionError, SMEError
from sme_registry.io import read_json
from sme_registry.spec import Setting

Float32 = npt.NDArray[np.float32]

CENSORED = 0.25
"""Farther away than this every reward is 0."""

LANES, ROUNDS = 20, 20  # of a budget
FIRST_OFFSET, LEAST_OFFSET = 0.15, 0.02
BATCH, RATE = 128, 0.005
STEPS_A_ROUND, LAST_STEPS, OFFLINE_STEPS = 250, 4000, 6000


class Optimum(nn.Module):
    """A guess of an optimal policy: of its architecture, and drawn as it is drawn.

    Biases follow from the weights, also while these are fitted.

    Args:
      setting: public, of the hidden task.
      seed: of the first weights.
    """

    def __init__(self, setting: Setting, seed: int) -> None:
        super().__init__()
        inner = [setting.hidden_width] * (setting.complexity - 1)
        widths = [setting.state_dim, *inner, setting.action_dim]
        generator = torch.Generator().manual_seed(seed)
        self.weights = nn.ParameterList()
        for fan_in, fan_out in itertools.pairwise(widths):
            weight = nn.init.orthogonal_(torch.empty(fan_out, fan_in), generator=generator)
            if setting.policy_init == "unit_variance":
                weight = weight / weight.norm(dim=1, keepdim=True)
            self.weights.append(nn.Parameter(math.sqrt(12) * weight))

    def forward(self, states: Tensor) -> Tensor:
        """Actions `[N, A]` in states `[N, S]`."""
        x = states
        for weight in self.weights:
            x = torch.special.ndtr((x - 0.5) @ weight.T)
        return x

    def act(self, observations: Float32) -> Float32:
        """Actions `[N, A]` for observations `[N, S + 2]`, which end with t/T and r_cum/k."""
        with torch.no_grad():
            actions: Float32 = self(torch.as_tensor(observations[:, :-2])).numpy()
        return actions


class Rows(NamedTuple):
    """What is known of an optimum.

    Attributes:
      states, actions: `[N, S]` and `[N, A]`.
      distances: `[N]` of the actions from the optimum; ¼ stands for all above.
    """

    states: Tensor
    actions: Tensor
    distances: Tensor

    @classmethod
    def of(cls, observations: Float32, actions: Float32, rewards: npt.NDArray[Any]) -> Rows:
        """Rows of transitions whose rewards are those of one step each."""
        distances = np.where(rewards > 0, (1 - rewards) / 4, CENSORED)
        arrays = observations[:, :-2], actions, distances
        return cls(*(torch.as_tensor(each, dtype=torch.float32) for each in arrays))

    @classmethod
    def joined(cls, *parts: Rows) -> Rows:
        """All rows of several."""
        return cls(*(torch.cat(each) for each in zip(*parts, strict=True)))


Loss = Callable[[Rows, float], Tensor]


def distance_errors(actions: Tensor, rows: Rows) -> Tensor:
    """`[N]`: how much farther the actions taken are from a guess than from the optimum."""
    errors = (actions - rows.actions).abs().mean(1) - rows.distances
    return errors * ((rows.distances < CENSORED) | (errors < 0))


def fit(net: nn.Module, rows: Rows, steps: int, loss: Loss, *, anneal: bool) -> None:
    """Fit a guess to rows by Adam.

    Args:
      net: the guess.
      rows: all that is known.
      steps: gradient steps.
      loss: of a batch of rows, and of the share of the steps that is done.
      anneal: whether the rate falls to 0, as a cosine; else it is constant.
    """
    adam = torch.optim.Adam(net.parameters(), lr=RATE)
    for step in range(steps):
        done = step / steps
        falling = (math.cos(math.pi * done) + 1) / 2 if anneal else 0.5
        adam.param_groups[0]["lr"] = RATE * min(1.0, (step + 1) / 50) * falling
        chosen = torch.randint(len(rows.states), (BATCH,))
        value = loss(Rows(*(each[chosen] for each in rows)), done)
        adam.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        adam.step()


def explore(url: str, ticket: seasons.Ticket, number: int, file: Path, effort: int = 1) -> Optimum:
    """Spend an instance's budget on measurements around the present guess, which they refine.

    With offsets ±δ that are larger than the guess's error, the distance is linear in the optimum:
    each step is an equation without noise. δ follows the error.

    Args:
      url, ticket, number: of the instance.
      file: keeps all rows.
      effort: multiplies the gradient steps.

    Returns:
      The last guess.
    """
    with seasons.Instance(url, ticket, number, lanes=LANES) as instance:
        setting, random = instance.setting, np.random.default_rng(number)
        _refuse_long_intervals(setting)
        net, offset = Optimum(setting, number), FIRST_OFFSET
        observations = instance.begin()
        known = [Rows(*torch.load(file))] if file.exists() else []

        def loss(rows: Rows, done: float) -> Tensor:
            return torch.mean(distance_errors(net(rows.states), rows) ** 2)

        while instance.steps_left >= LANES:
            if known:
                fit(net, Rows.joined(*known), effort * STEPS_A_ROUND, loss, anneal=False)
            new = []
            for _ in range(min(instance.budget // ROUNDS, instance.steps_left) // LANES):
                half = np.full((LANES, setting.action_dim), 0.5)
                guess = net.act(observations) if known else half
                signs = random.choice([-1, 1], guess.shape)
                actions: Float32 = np.clip(guess + offset * signs, 0, 1).astype(np.float32)
                steps = instance.step(actions)
                new.append(Rows.of(observations, actions, steps.reward))
                observations = steps.observation
            latest = Rows.joined(*new)
            if known:
                with torch.no_grad():
                    error = distance_errors(net(latest.states), latest).abs().mean().item()
                offset = min(max(1.5 * error, LEAST_OFFSET), FIRST_OFFSET)
            known.append(latest)
            save(Rows.joined(*known), file)
    fit(net, Rows.joined(*known), effort * LAST_STEPS, loss, anneal=True)
    return net


def learn(data: SealedDataset, setting: Setting, seed: int, effort: int = 1) -> Optimum:
    """Fit a guess to a data set, whose distances tell which actions are nearly optimal.

    Args:
      data: its actions are those of any policy.
      setting: public, of the hidden task.
      seed: of the first weights.
      effort: multiplies the gradient steps.
    """
    _refuse_long_intervals(setting)
    net = Optimum(setting, seed)

    def loss(rows: Rows, done: float) -> Tensor:
        actions = net(rows.states)
        weights = (rows.distances + 0.02) ** -2
        errors = ((actions - rows.actions) ** 2).mean(1)
        nearly_optimal = (weights * errors).mean() / weights.mean()
        error: Tensor = torch.mean(distance_errors(actions, rows) ** 2)
        total: Tensor = error + (1 - done) ** 2 * nearly_optimal
        return total

    rows = Rows.of(data.observations, data.actions, data.rewards)
    fit(net, rows, effort * OFFLINE_STEPS, loss, anneal=True)
    return net


def _refuse_long_intervals(setting: Setting) -> None:
    if setting.k > 1:
        raise OptionError(f"k={setting.k}: must be 1: this player takes rewards for step rewards.")


def save(rows: Rows, file: Path) -> None:
    """Write rows, completely or not at all."""
    new = file.with_name(f"new.{file.name}")
    torch.save(tuple(rows), new)
    os.replace(new, file)


def play_online(url: str, file: Path, folder: Path, effort: int) -> None:
    """Play and answer all instances of a ticket."""
    ticket = seasons.Ticket.read(file)
    with seasons.Instance(url, ticket) as first:
        phases = [each.phase for each in first.status().instances]
    for number, place in enumerate(ticket.places):
        if phases[number] != "answered":
            begun = time.process_time()
            net = explore(url, ticket, number, folder / f"{place.name}.rows.pt", effort)
            seasons.answer(url, ticket, net.act, number)
            report(place.name, begun)


def play_offline(published: Path, folder: Path, effort: int) -> None:
    """Write the actions in the challenge states of all instances of a season."""
    season = read_json(published / "season.json")
    for member in season["classes"]:
        setting = Setting.from_dict(member["setting"])
        for number in range(member["instances"]):
            begun, name = time.process_time(), f"{member['name']}-{number}"
            data = SealedDataset.read(published / f"datasets/sealed/{season['id']}/{name}-v0")
            net = learn(data, setting, number, effort)
            np.save(folder / f"{name}.npy", net.act(np.load(published / f"challenges/{name}.npy")))
            report(name, begun)


def report(name: str, begun: float) -> None:
    """Print what an instance has cost."""
    print(f"{name}: {time.process_time() - begun:.0f} s of processor time", flush=True)


def main() -> int:
    """Play a season."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    tracks = parser.add_subparsers(dest="track", required=True)
    online, offline = (tracks.add_parser(name) for name in ("online", "offline"))
    online.add_argument("url")
    online.add_argument("ticket", type=Path)
    offline.add_argument("published", type=Path, help="the folder that the organiser published")
    for each in (online, offline):
        each.add_argument("--out", type=Path, required=True, help="folder of rows and answers")
        each.add_argument("--effort", type=int, default=1, help="multiplies the gradient steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # networks this small are slower on several threads
    torch.manual_seed(0)
    arguments.out.mkdir(parents=True, exist_ok=True)
    try:
        if arguments.track == "online":
            play_online(arguments.url, arguments.ticket, arguments.out, arguments.effort)
        else:
            play_offline(arguments.published, arguments.out, arguments.effort)
    except SMEError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
