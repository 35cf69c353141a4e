"""A hidden task of a ticket, stepped and answered over the network; as Gymnasium's environments.

No request of this protocol has a further effect when it is repeated (`wire`), so a lost connection
or a server that is being restarted costs time and nothing else. What was sent and answered is kept
beside the ticket's file, and signed (`transcript`).
"""

from __future__ import annotations

import os
from typing import Any, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from sme_registry.envs import arguments
from sme_registry.errors import (
    EpisodeError,
    OptionError,
    PolicyError,
    SealedError,
)
from sme_registry.evaluation import Policy
from sme_registry.evaluation.policies import as_policy
from sme_registry.evaluation.references import OLD_NAMES, POLICIES
from sme_registry.evaluation.regions import batch_rows
from sme_registry.io import integer_in, parse_json, server_address
from sme_registry.seasons.transcript import (
    EVERY,
    Chain,
    Ending,
    TicketHeads,
    Transcript,
    answers_head,
    challenge_head,
    next_head,
)
from sme_registry.seasons.wire import (
    PATIENCE,
    Connection,
    Float32,
    StepFormat,
    StepsAnswer,
    Ticket,
    TicketStatus,
    instance_path,
    pack_table,
    ticket_path,
    unpack_table,
)
from sme_registry.spec import Setting, SMESpec
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.task.task import Action, Array, Mask, Observation

TicketLike = Ticket | str | os.PathLike[str]

WITHOUT_TASK = ("constant", "constant_half", "random", "uniform_random")
"""Reference policies that are the same on each task."""


class Instance:
    """A hidden task of a ticket, as its server shows it: observations, rewards and ends.

    Only one process at a time can step an instance. Another one can go on, where it has the
    transcript that is kept beside the ticket's file.

    Attributes:
      setting: all of the task's spec but its seed.
      budget: steps over all lanes.
      lanes: L, copies that are stepped together; fixed after the first step.
      number: of the last steps that were taken; 0 before the first.

    Examples:
      >>> from sme_registry.seasons import Instance
      >>> Instance("https://board.example", "ticket.json", lanes=4).setting.complexity
      10
    """

    def __init__(
        self,
        url: str,
        ticket: TicketLike,
        instance: int = 0,
        lanes: int = 1,
        *,
        insecure: bool = False,
        patience: float = PATIENCE,
    ) -> None:
        ticket = ticket if isinstance(ticket, Ticket) else Ticket.read(ticket)
        member = ticket.place(instance).member
        self.setting: Setting = member.setting
        self.budget = member.budget
        self.number = 0
        self._set_lanes(integer_in("lanes", lanes, 1, ticket.lanes))
        if ticket.signer is None:
            raise OptionError(
                "ticket: has no key to sign what is sent. Give the file that `sme-leaderboard "
                "ticket` wrote."
            )
        address = server_address(url, insecure=insecure).url
        if ticket.signer.address not in (None, address):
            raise OptionError(
                f"url={address!r:.80}: must be {ticket.signer.address}, where the ticket was "
                "started: another server could take its steps."
            )
        self._ticket, self._instance, self._signer = ticket, instance, ticket.signer
        self._chain = Chain(request=ticket.signer.request, ticket=ticket.ticket, instance=instance)
        self._transcript = self._transcript_of(instance)
        self._has_begun = False
        self._connection = Connection(url, ticket.token, insecure=insecure, patience=patience)

    @property
    def steps_left(self) -> int:
        return self.budget - self.number * self.lanes

    def begin(self) -> Float32:
        """Begin, or go on after the last steps of any process: observations `[L, S + 2]`."""
        data = self._request("POST", f"start?lanes={self.lanes}", most=self._format.answer_bytes)
        number, observation = self._format.unpack_start(data)
        kept = self._transcript
        if not (kept.signed <= number <= kept.sent):
            raise SealedError(
                "transcript",
                f"{kept.path}: has {kept.sent} requests for steps, and {kept.signed} of them are "
                f"signed; the server has {number}. What was not sent here is not signed: go on "
                "with the ticket's folder in which these steps were taken.",
            )
        if number == 0:
            kept.begin(self.lanes, self._chain.first_head(self.lanes, data))
        else:
            observation = self._sent_again(number).observation
        self.number, self._has_begun = number, True
        return observation

    def _sent_again(self, number: int) -> StepsAnswer:
        """The answer to the last request, which the chain needs, and a killed process has lost."""
        kept = self._transcript
        body = number.to_bytes(8, "little") + kept.actions(number)
        data = self._request("POST", "steps", body, most=self._format.answer_bytes)
        head = next_head(kept.head(number - 1), body, data)
        if kept.head(number) not in (b"", head):
            raise self._shown_otherwise(f"another answer to request {number}")
        kept.receive(number, head)
        return self._format.unpack_steps(data)

    def step(self, actions: npt.NDArray[np.floating]) -> StepsAnswer:
        """One step of every lane by finite actions `[L, A]` in [0, 1]; call `begin` first."""
        number, kept = self.number + 1, self._transcript
        body = self._format.pack(number, actions)
        due = self.number > 0 and self.number % EVERY == 0
        action = f"steps?signature={self._signature()}" if due else "steps"
        try:
            kept.send(number, body[8:])
            data = self._request("POST", action, body, most=self._format.answer_bytes)
        except SealedError as error:
            if error.code in ("step_conflict", "step_ahead"):
                raise SealedError(
                    error.code,
                    f"{error.message} Call `begin` (of an environment, `reset`) to go on from the "
                    "present observation; no other process may step the instance.",
                ) from None
            # Refused, these steps were not taken; where a server fails, they may have been.
            if error.code not in ("unreachable", "wire", "http", "internal"):
                kept.receive(self.number, kept.head(self.number))
            raise
        steps = self._format.unpack_steps(data)
        kept.receive(number, next_head(kept.head(self.number), body, data))
        self.number = number
        return steps

    def challenge(self) -> Float32:
        """End the stepping, and return the challenge states: observations `[rows, S + 2]`."""
        kept = self._transcript
        ending = kept.ending
        if ending is None and not self._has_begun:
            started = self.status().instances[self._instance].lanes
            self._set_lanes(kept.lanes or started or self.lanes)
            self.begin()
        if ending is None:
            self._request("POST", f"finish?signature={self._signature()}")
        number = self.number if ending is None else ending.requests
        data = self._request("GET", "challenge", most=2**28)
        head = challenge_head(kept.head(number), data).hex()
        if ending is None:
            kept.end(Ending(request=self._chain.request, requests=number, challenge=head))
        elif ending.challenge != head:
            raise self._shown_otherwise("other challenge states")
        return unpack_table(data, self.setting.state_dim + 2)

    def send_answers(self, actions: npt.NDArray[np.floating]) -> None:
        """Sign and send the actions `[rows, A]` in the challenge states; the last end the ticket.

        The challenge states must have been asked for here.
        """
        data, ending = pack_table(actions), self._transcript.ending
        if ending is None:
            raise SealedError(
                "instance_phase",
                f"{self._transcript.path}: has no challenge states. Ask for them first.",
            )
        head = answers_head(bytes.fromhex(ending.challenge), data)
        signature = self._signer.sign(self._chain.at(ending.requests + 2, head))
        self._request("PUT", f"answers?signature={signature}", data)
        self._transcript.end(ending.model_copy(update={"answers": head.hex()}))
        self.end_ticket()

    def end_ticket(self) -> bool:
        """Sign all transcripts, and end the ticket; False if not all of it was answered here.

        It then ends at its deadline.
        """
        endings = [
            self._transcript_of(instance).ending for instance, _ in enumerate(self._ticket.places)
        ]
        heads = [f"sha256:{each.answers}" for each in endings if each and each.answers]
        if len(heads) < len(endings):
            return False
        chain = self._chain
        document = TicketHeads(request=chain.request, ticket=chain.ticket, heads=tuple(heads))
        path = ticket_path(self._ticket.season, self._ticket.ticket)
        self._connection.request("POST", f"{path}/end?signature={self._signer.sign(document)}")
        return True

    def status(self) -> TicketStatus:
        path = ticket_path(self._ticket.season, self._ticket.ticket)
        data = self._connection.request("GET", path, most=2**22)
        status = TicketStatus.from_dict(parse_json(data, "answer"), "answer")
        count, expected = len(status.instances), sum(1 for _ in self._ticket.places)
        if count != expected:
            raise SealedError("wire", f"answer: has {count} instances: must have {expected}.")
        return status

    def __enter__(self) -> Instance:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()
        self._transcript.close()

    def _shown_otherwise(self, what: str) -> SealedError:
        return SealedError(
            "transcript",
            f"{self._transcript.path}: the server has shown {what} before, so nothing is signed. "
            "Ask the board's owner.",
        )

    def _set_lanes(self, lanes: int) -> None:
        self.lanes = lanes
        self._format = StepFormat(lanes, self.setting.state_dim, self.setting.action_dim)

    def _transcript_of(self, instance: int) -> Transcript:
        chain = self._chain.model_copy(update={"instance": instance})
        action_dim = self._ticket.place(instance).member.setting.action_dim
        return Transcript(self._ticket.path, chain, action_dim)

    def _signature(self) -> str:
        """Of the transcript up to here."""
        head = self._transcript.head(self.number)
        return self._signer.sign(self._chain.at(self.number, head))

    def _request(self, method: str, action: str, body: bytes = b"", *, most: int = 0) -> bytes:
        ticket = self._ticket
        path = instance_path(ticket.season, ticket.ticket, self._instance, action)
        return self._connection.request(method, path, body, most=most)


class SealedVectorEnv(VectorEnv[Observation, Array, Array]):
    """The lanes of a hidden task, stepped together by the season's server.

    Spaces, rewards and ends of episodes are those of `SMEVectorEnv` in the autoreset mode
    "SameStep"; seeds and resets are as in `SealedEnv`. `instance` has the budget and the answers.
    """

    def __init__(self, instance: Instance, action_range: ActionRange = "unit") -> None:
        self.instance = instance
        self.num_envs = instance.lanes
        self.metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        A, width = instance.setting.action_dim, instance.setting.state_dim + 2
        self.single_action_space, self._rescaled = arguments.action_space(action_range, A)
        self.single_observation_space = gymnasium.spaces.Box(0.0, 1.0, (width,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._has_begun = False

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        first = arguments.checked_seed(seed[0] if isinstance(seed, list) else seed)
        if options:
            raise OptionError(
                f"options={options!r:.60}: must be None: the server draws the states at which "
                "episodes begin. Leave it out."
            )
        observation = self.instance.begin()
        self._has_begun = True
        super().reset(seed=first)
        return observation, {}

    def step(  # type: ignore[override]  # Gymnasium types all three arrays alike; ends are bool
        self, actions: Any
    ) -> tuple[Observation, Float32, Mask, Mask, dict[str, Any]]:
        if not self._has_begun:
            raise EpisodeError("step: the episodes have not begun. Call reset() first.")
        shape = self.num_envs, self.instance.setting.action_dim
        unit = arguments.to_unit(actions, shape, self._rescaled)
        if not np.isfinite(unit).all():
            raise arguments.not_finite_error()
        steps = self.instance.step(unit)
        ended: Mask = steps.terminated | steps.truncated
        infos: dict[str, Any] = {}
        if ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for lane in np.flatnonzero(ended):
                final[lane] = steps.last_observation[lane]
            infos = {"final_obs": final, "_final_obs": ended.copy()}
            infos |= {"final_info": {}, "_final_info": ended.copy()}
        return steps.observation, steps.reward, steps.terminated, steps.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        self.instance.close()


class SealedEnv(gymnasium.Env[Observation, Action]):
    """A hidden task of a ticket, stepped by the season's server.

    Spaces, rewards and ends of episodes are those of `SMEEnv`; infos are empty. The server draws
    the initial states: `seed` seeds `np_random` only. `reset` within an episode does not end it: it
    returns the present observation, also in a new process that goes on where another one stopped.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, instance: Instance, action_range: ActionRange = "unit") -> None:
        self.instance = instance
        self._lane = SealedVectorEnv(instance, action_range)
        self.action_space = cast("gymnasium.Space[Action]", self._lane.single_action_space)
        self.observation_space = self._lane.single_observation_space
        self._next: Observation | None = None  # the first of the next episode

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode, or go on with the present one."""
        if self._next is None or options or seed is not None:
            [self._next] = self._lane.reset(seed=seed, options=options)[0]
        super().reset(seed=seed)
        observation, self._next = self._next, None
        return observation, {}

    def step(self, action: Any) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step; an action that is not finite, or not `[A]`, is never sent."""
        if self._next is not None:
            raise EpisodeError("step: the episode has ended. Call reset() first.")
        [observation], [reward], [terminated], [truncated], infos = self._lane.step([action])
        if infos:
            self._next, observation = observation, infos["final_obs"][0]
        return observation, float(reward), bool(terminated), bool(truncated), {}

    def close(self) -> None:
        """Close the connection. The ticket stays valid."""
        self.instance.close()


def make(
    url: str,
    ticket: TicketLike,
    instance: int = 0,
    *,
    action_range: ActionRange = "unit",
    insecure: bool = False,
    patience: float = PATIENCE,
) -> SealedEnv:
    """An environment of a hidden task: that of the ticket with the number `instance`, from 0.

    `ticket` may be the path of its file. `insecure` allows plain http to other machines, in a
    network that you trust. A request without an answer is repeated for `patience` seconds.

    Examples:
      >>> from sme_registry import seasons
      >>> env = seasons.make("https://board.example", "ticket.json")
      >>> env.observation_space.shape
      (10,)
    """
    hidden = Instance(url, ticket, instance, insecure=insecure, patience=patience)
    return SealedEnv(hidden, action_range)


def make_vec(
    url: str,
    ticket: TicketLike,
    instance: int = 0,
    num_envs: int = 1,
    *,
    action_range: ActionRange = "unit",
    insecure: bool = False,
    patience: float = PATIENCE,
) -> SealedVectorEnv:
    """A vector environment of a hidden task: `num_envs` lanes in one request.

    They are at most the ticket's `lanes`, and fixed after the first step. The rest is as in `make`.

    Examples:
      >>> from sme_registry import seasons
      >>> envs = seasons.make_vec("https://board.example", "ticket.json", num_envs=4)
      >>> envs.observation_space.shape
      (4, 10)
    """
    hidden = Instance(url, ticket, instance, num_envs, insecure=insecure, patience=patience)
    return SealedVectorEnv(hidden, action_range)


def answer(
    url: str,
    ticket: TicketLike,
    policy: Any,
    instance: int = 0,
    *,
    action_range: str | None = None,
    algorithm: str | None = None,
    insecure: bool = False,
    patience: float = PATIENCE,
) -> None:
    """End an instance's stepping, and send a policy's actions in its challenge states.

    The other arguments are those of `make` and `prepare_policy`.

    Examples:
      >>> from sme_registry.seasons import answer
      >>> answer("https://board.example", "ticket.json", "constant", instance=2)
      Traceback (most recent call last):
      ...
      sme_registry.errors.OptionError: instance=2: must be an integer in [0, 1].
    """
    with Instance(url, ticket, instance, insecure=insecure, patience=patience) as hidden:
        prepared = prepare_policy(  # before the stepping ends for good
            policy, hidden.setting, action_range=action_range, algorithm=algorithm
        )
        hidden.send_answers(actions_in(hidden.challenge(), prepared, hidden.setting))


def prepare_policy(
    policy: Any,
    setting: Setting,
    *,
    action_range: str | None = None,
    algorithm: str | None = None,
) -> Policy:
    """A policy for the hidden tasks of a setting; arguments as `evaluate` accepts them.

    A reference policy that depends on the hidden task is refused.
    """
    if isinstance(policy, str) and policy in {*POLICIES, *OLD_NAMES} - {*WITHOUT_TASK}:
        raise PolicyError(
            f"policy={policy!r}: follows from the task, which is hidden. Give a policy of your "
            "own, constant or random."
        )
    prepared = as_policy(policy, _any_spec(setting), action_range=action_range, algorithm=algorithm)
    assert isinstance(prepared, Policy)  # seasons have no teams
    return prepared


def actions_in(states: Float32, policy: Any, setting: Setting) -> Float32:
    """A policy's actions `[rows, A]` in challenge states `[rows, S + 2]`: finite, not clipped."""
    prepared, rows = prepare_policy(policy, setting), batch_rows(_any_spec(setting))
    batches = [prepared(states[at : at + rows].copy()) for at in range(0, len(states), rows)]
    return np.concatenate([np.empty((0, setting.action_dim)), *batches]).astype(np.float32)


def _any_spec(setting: Setting) -> SMESpec:
    return SMESpec.from_dict({**setting.to_dict(), "seed": 0})
