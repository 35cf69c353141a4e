"""What environments have in common: their task, their names in Gymnasium, and their cards."""

from __future__ import annotations

import copy
import sys
from enum import Enum
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec

from sme_registry.errors import WrapperError
from sme_registry.spec import SMESpec, StreamSpec
from sme_registry.spec.catalogue import NAMESPACE
from sme_registry.task import Task
from sme_registry.task.draw import DYNAMICS_VERSION

_STATUS = {"created": "not begun", "running": "running", "ended": "ended"}


class TaskMixin:
    """The task of an environment."""

    _task: Task

    @property
    def task(self) -> Task:
        """The drawn task: W, b, the layers of each agent, and the equations."""
        return self._task

    @property
    def sme_spec(self) -> SMESpec:
        """The spec of the task that is run, overrides included."""
        return self._task.spec

    @property
    def document(self) -> SMESpec | StreamSpec:
        """What the environment runs: its spec, or a stream."""
        return self._task.spec


class GymnasiumMixin(TaskMixin):
    """A task's environment in Gymnasium's registry."""

    _env_spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """Gymnasium's spec; a derived task has an id of its own, by its content.

        Its `max_episode_steps` is the horizon.
        """
        return self._env_spec

    @spec.setter
    def spec(self, value: EnvSpec | None) -> None:
        self._env_spec = renamed_by_content(value, self.document)

    @property
    def stream(self) -> StreamSpec:
        """The stream that is run; an environment of a task has no such attribute."""
        if not isinstance(self.document, StreamSpec):
            raise AttributeError(f"stream: {self!r} runs a task. Its spec is sme_spec.")
        return self.document


def check_outer_time_limit(horizon: int) -> None:
    """Raise where the `reset` that calls this was called by a TimeLimit below the horizon.

    Such a wrapper ends an episode before its last payout. An environment has no reference to its
    wrappers, which may be added at any time; but each calls the `reset` of the environment inside
    it, so the callers' frames up to the first that is no reset belong to the wrappers (and to
    Gymnasium's function that checks a first reset).
    """
    frame = sys._getframe(2)
    while frame is not None and "reset" in frame.f_code.co_name:
        wrapper = frame.f_locals.get("self")
        if isinstance(wrapper, gymnasium.wrappers.TimeLimit):
            check_time_limit(wrapper._max_episode_steps, horizon)
        frame = frame.f_back  # type: ignore[assignment]  # typed as never None


def check_time_limit(max_episode_steps: int, horizon: int) -> None:
    """Raise WrapperError on a time limit below the horizon."""
    if max_episode_steps < horizon:
        raise WrapperError(
            f"max_episode_steps={max_episode_steps}: must be at least the horizon, {horizon}: a "
            "shorter TimeLimit would end the episode before its last payout. Make the task itself "
            f"shorter, horizon={max_episode_steps}; or, where the limit comes from the EnvSpec of "
            f"another horizon, pass max_episode_steps={horizon}."
        )


def content_id(document: SMESpec | StreamSpec) -> str:
    """`SME/sha256-<first 12 hex of the digest>-v1`."""
    return f"{NAMESPACE}/{document.content_name}-v{DYNAMICS_VERSION}"


def renamed_by_content(env_spec: EnvSpec | None, document: SMESpec | StreamSpec) -> EnvSpec | None:
    """Gymnasium's spec of an environment, as plain JSON; a derived task gets the id of its content.

    `SME/Default-v1` with `complexity=10` is another task, and must not be recorded under the name
    from which it was derived. Its `max_episode_steps` is the horizon, which wrappers ask for; a
    TimeLimit that Gymnasium makes of it changes nothing, as the environment ends by itself.
    """
    if env_spec is None:
        return None
    fields = SMESpec.model_fields.keys()
    registered = gymnasium.registry.get(env_spec.id)
    argument = document.kind
    value = env_spec.kwargs.get(argument)
    is_named = registered is None or registered.kwargs.items() <= env_spec.kwargs.items()
    named = is_named and not fields & env_spec.kwargs.keys()

    plain = copy.deepcopy(env_spec)
    plain.kwargs = {
        key: value.value if isinstance(value, Enum) else value
        for key, value in plain.kwargs.items()
        if key not in fields and key != "max_episode_steps"
    }
    plain.max_episode_steps = document.horizon
    if not named or not isinstance(value, str | dict):
        plain.kwargs[argument] = document.to_dict()
    if not named:
        plain.id = content_id(document)
        # EnvSpec derives these from the id only in its constructor.
        plain.name = plain.id.removeprefix(f"{NAMESPACE}/").rsplit("-v", 1)[0]
        plain.version = DYNAMICS_VERSION
    return plain


def html_card(
    env: Any,
    observation: Any,
    action: Any,
    *,
    status: str | None = None,
    autoreset: str | None = None,
) -> str:
    """A card of an environment for notebooks; a team's has its agents in place of the spaces.

    The spaces are those of a single environment, or of any agent in a team; `status` is "created",
    "running" or "ended", and None for a batch.
    """
    from sme_registry.io.markup import card, folded, pairs_html  # loads Jinja
    from sme_registry.spec import cards

    document: SMESpec | StreamSpec = env.document
    seen = cards.observation_text(document)
    span = f"float32 in [{action.low.flat[0]:g}, {action.high.flat[0]:g}]"
    facts = {
        "observation": f"[{observation.shape[0]}] float32 in [0, 1]: {seen}",
        "action": f"[{action.shape[0]}] {span}",
    }
    if document.specs[0].team is not None:  # whose spaces are in the table of its agents
        facts = {"actions": span}
    facts["episode"] = f"at most {document.horizon:,} steps"
    if status is not None:
        facts["episode"] += f"; {_STATUS[status]}"
    if autoreset is not None:
        facts["autoreset"] = autoreset
    task = folded(cards.summary(document), *cards.parts(document))
    return card(pairs_html(repr(env), facts), task)
