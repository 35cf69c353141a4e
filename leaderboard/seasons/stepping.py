"""`Play`: one hidden instance after so many requests: its lanes, its transcript, and the regret.

All follows from the start and the requests, so a replay of the same actions gives the same numbers,
bit for bit, and so does a snapshot. `L` lanes, `S` state_dim, `A` action_dim.

    normalised online regret = Σ regret / Σ regret of the constant ½ in the same states

over the budget, and over each part of it. Steps that were not taken, or that the entrant has not
signed, count like the constant's: what took a share f of its steps, with the ratio q, has
f q + 1 − f. Steps at the end of the budget into which no request of all lanes fits cannot be taken,
and do not count.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from leaderboard.seasons.season import Stepping
from sme_registry.envs import SMEVectorEnv
from sme_registry.seasons.transcript import Place, next_head
from sme_registry.seasons.wire import StepFormat, StepsAnswer
from sme_registry.spec import SMESpec

MOST_PARTS = 100
Arrays = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class Start:
    """What the steps of an instance follow from, besides the actions; `repr` does not show it."""

    spec: SMESpec = field(repr=False)  # the hidden task
    seed: int = field(repr=False)  # of the first lane's episodes; lane i has seed + i
    place: Place


class Play:
    """An instance that has begun, with a budget of steps over all its lanes.

    `head` is that of the transcript after all `requests`, `last` the last request and its answer,
    and `signed` how many requests the entrant has signed: −1 before the first signature.
    """

    def __init__(self, start: Start, lanes: int, budget: int) -> None:
        self._start, self._env = start, SMEVectorEnv(start.spec, lanes, autoreset_mode="SameStep")
        self._format = StepFormat(lanes, start.spec.state_dim, start.spec.action_dim)
        self._observation = self._env.reset(seed=start.seed)[0]
        self._possible = budget // lanes
        # Regret, that of the constant ½, and requests, of each part of the budget.
        self._sums = np.zeros((min(MOST_PARTS, self._possible), 3))
        self._signed_sums = self._sums.copy()
        self.requests, self.signed, self.last = 0, -1, (b"", b"")
        self.head = start.place.first_head(lanes, self.started)

    @property
    def started(self) -> bytes:
        """The answer to a request to begin, or to go on."""
        return self._format.pack(self.requests, self._observation)

    def unpack(self, body: bytes) -> int:
        """The number of a request for steps; raises what `StepFormat.unpack_request` raises."""
        return self._format.unpack_request(body)[0]

    def take(self, body: bytes) -> bytes:
        """Take the steps of the next request; its answer."""
        _, actions = self._format.unpack_request(body)
        observation, reward, terminated, truncated, info = self._env.step(actions)
        ended = terminated | truncated
        last = np.zeros_like(observation)
        if "final_obs" in info:
            last[ended] = np.stack(info["final_obs"][ended])
            for name in ("regret", "optimal_action"):  # the rows are already of the next episode
                info[name][ended] = info["final_info"][name][ended]
        task = self._env.task
        half = 1.0 - task.reward_of(task.similarity_of(np.array(0.5), info["optimal_action"]))
        part = self.requests * len(self._sums) // self._possible
        self._sums[part] += float(info["regret"].sum()), float(half.sum()), 1.0
        steps = StepsAnswer(observation, reward.astype(np.float32), terminated, truncated, last)
        answer = self._format.pack_steps(steps)
        self.head = next_head(self.head, body, answer)
        self._observation, self.last = observation, (body, answer)
        self.requests += 1
        return answer

    def sign(self) -> None:
        """Note that the entrant has signed all of this."""
        self.signed, self._signed_sums = self.requests, self._sums.copy()

    @property
    def stepping(self) -> Stepping:
        """The regret of the steps that the entrant has signed."""
        parts = len(self._sums)
        firsts = -(np.arange(parts + 1) * -self._possible // parts)  # request of each part
        return Stepping(
            steps=max(self.signed, 0) * self._format.lanes,
            normalised_online_regret=_ratio(self._signed_sums.sum(axis=0), self._possible),
            learning_curve=tuple(map(_ratio, self._signed_sums, np.diff(firsts))),
        )

    def snapshot(self) -> bytes:
        """All of it but the start: arrays in an .npz file."""
        stream = io.BytesIO()
        texts = {"head": self.head, "body": self.last[0], "answer": self.last[1]}
        arrays: dict[str, Any] = {
            "counts": np.array([self.requests, self.signed]),
            "observation": self._observation,
            "sums": self._sums,
            "signed_sums": self._signed_sums,
            **{name: np.frombuffer(text, np.uint8) for name, text in texts.items()},
            **self._env.snapshot(),
        }
        np.savez(stream, **arrays)
        return stream.getvalue()

    def restore(self, snapshot: Arrays) -> None:
        """Go on from the arrays of a snapshot of the same start."""
        self._env.restore(snapshot, self._start.seed)
        self.requests, self.signed = snapshot["counts"].tolist()
        self._observation = snapshot["observation"]
        self._sums, self._signed_sums = snapshot["sums"], snapshot["signed_sums"]
        self.head = snapshot["head"].tobytes()
        self.last = snapshot["body"].tobytes(), snapshot["answer"].tobytes()


def no_steps(budget: int, lanes: int = 1) -> Stepping:
    """The regret of an instance that took no steps; `lanes` is 1 before the start."""
    curve = (1.0,) * min(MOST_PARTS, budget // lanes)
    return Stepping(steps=0, normalised_online_regret=1.0, learning_curve=curve)


def _ratio(sums: npt.NDArray[np.float64], possible: int) -> float:
    """Regret relative to the constant's, from `sums` of both and of the requests taken."""
    regret, half, taken = map(float, sums)
    share = taken / float(possible)
    # The constant has no regret only where π* is ½ throughout, and so has none either.
    return share * (regret / half if half > 0.0 else 0.0) + 1.0 - share
