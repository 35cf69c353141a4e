"""`FunctionLearner`: a function of yours as a `Learner`, written with any framework.

    def train(env, steps, seed):            # `train:module:train` in `sme train -a` and in plans
        ...                                 # takes at most `steps` steps of `env`
        return policy                       # from observations [B, O] to actions [B, A]

`env` is a Gymnasium environment of one task, with the exact regret of each step in its info.
Hyperparameters are keyword arguments. The policy acts in the environment's action space; a model
with `predict`, as those of Stable-Baselines3, and a PyTorch module are policies, too. It is
evaluated once, at the end of its training.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import importlib.machinery
import importlib.util
import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Never

import gymnasium
import numpy as np

from sme_registry.envs import SMEEnv
from sme_registry.envs.episodes import Episode, Episodes, info_of_lanes
from sme_registry.errors import OptionError, PolicyError, did_you_mean
from sme_registry.evaluation import Policy, TeamPolicy, as_policy
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import write_atomically
from sme_registry.spec import ActionRange, SMESpec
from sme_registry.spec.study import parse_uses

if TYPE_CHECKING:
    from sme_registry.training.learn import Watch


class FunctionLearner:
    """A function `train(env, steps, seed) -> policy` in its environment.

    Attributes:
      env: the environment, which counts its steps.
      model: the policy that the function returned.
      source: the digest of the module's source.
    """

    def __init__(
        self,
        name: str,
        spec: SMESpec,
        *,
        seed: int,
        steps: int,
        hyperparameters: Mapping[str, Any],
        action_range: ActionRange,
        field: str = "uses",
    ) -> None:
        self._named, self._spec, self._action_range = f"{field}='train:{name}'", spec, action_range
        self._seed, self.total, self._hyperparameters = seed, steps, dict(hyperparameters)
        self._function, self.source = load_function(name, field)
        self.env = CountedEnv(SMEEnv(spec, action_range=action_range), steps, self._named)
        self.model: Any = None
        try:
            inspect.signature(self._function).bind(self.env, steps, seed, **self._hyperparameters)
        except TypeError as error:
            raise OptionError(
                f"{self._named}: cannot be called with an environment, steps, a seed and the "
                f"hyperparameters {sorted(hyperparameters)}: {error}. Define "
                f"{name.partition(':')[2]}(env, steps, seed), and hyperparameters by name."
            ) from None

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return self.env.steps

    def learn(self, watch: Watch) -> None:
        """Call the function; after each step, `watch.on_steps`."""
        self.env.after_step = watch.on_steps
        self.env.reset(seed=self._seed)  # so that episodes without a seed are reproducible
        with working_directory_importable():
            self.model = self._function(self.env, self.total, self._seed, **self._hyperparameters)
        is_policy = callable(self.model) or hasattr(self.model, "predict")
        if not is_policy or isinstance(self.model, type):
            raise PolicyError(
                f"{self._named}: returned {self.model!r:.80}: must be a policy. Return a function "
                f"from observations [B, {self._spec.observation_dim}] to actions "
                f"[B, {self._spec.action_dim}], or a model with predict, as those of "
                "Stable-Baselines3."
            )

    def policy(self) -> Policy | TeamPolicy:
        """The policy that the function returned."""
        return as_policy(self.model, self._spec, action_range=self._action_range)

    def add_to(self, sums: Episodes) -> list[Episode]:
        """Add the last step to sums; returns the episode that ended in it."""
        reward, terminated, truncated, info = self.env.last
        ended = [terminated or truncated]
        return sums.add([reward], info_of_lanes([info]), [terminated], ended)

    def is_finite(self) -> bool:
        """True: its weights are unknown, and its actions are checked when it is evaluated."""
        return True

    def restore(self, checkpoint: Path) -> Never:
        """A function has no checkpoints."""
        raise OptionError(f"{self._named}: has no checkpoints. Use --force to start again.")

    def save_checkpoint(self, path: Path, sums: Any) -> None:
        """Write none."""

    def save(self, path: Path) -> None:
        """Write a model of Stable-Baselines3, and nothing of another policy."""
        kinds = sys.modules.get("stable_baselines3.common.base_class")
        if kinds is not None and isinstance(self.model, kinds.BaseAlgorithm):
            write_atomically(path, saved_sb3(self.model))

    def begin_log(self, folder: Path) -> None:
        """Write no log: frameworks have their own."""

    def log(self, episodes: Sequence[Episode]) -> None:
        """Write no log."""

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


class CountedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that takes no more than its steps, and counts their regret and CPU seconds.

    Attributes:
      steps: taken so far.
      seconds: of this thread, in these steps.
      regret: the sum over them, `[1]`.
      cost: of a task with `safety`, the sum over them; None of any other.
      last: reward, terminated, truncated and info of the last one.
    """

    def __init__(self, env: SMEEnv, budget: int, named: str) -> None:
        super().__init__(env)
        self._budget, self._named = budget, named
        self.steps, self.seconds, self.regret = 0, 0.0, np.zeros(1)
        self.cost: float | None = None if env.sme_spec.safety is None else 0.0
        self.last: tuple[Any, bool, bool, dict[str, Any]] = (0.0, False, False, {})
        self.after_step: Callable[[], None] = lambda: None

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """One step; PolicyError beyond the budget."""
        if self.steps >= self._budget:
            raise PolicyError(
                f"{self._named}: takes more than {self._budget:,} steps: must stop at the steps "
                "that it is given. Choose rollouts and evaluations of your own that fit, or give "
                "more steps."
            )
        begun = time.thread_time()
        result = self.env.step(action)
        self.seconds += time.thread_time() - begun
        info = result[4]
        self.steps += 1
        self.regret += info["regret"]
        if self.cost is not None:
            self.cost += info["cost"]
        self.last = (float(result[1]), *result[2:])
        self.after_step()
        return result


def source_of(uses: str, field: str = "uses") -> str | None:
    """The digest of the module's source of `train:module:function`, which is not imported."""
    kind, name = parse_uses(uses)
    return _source(name, field)[1] if kind == "train" else None


def load_function(name: str, field: str = "uses") -> tuple[Callable[..., Any], str]:
    """The function `module:function` of the source that is there now, and the source's digest.

    The source is run again where it has changed since, so what runs is what the digest says.
    """
    module_name, _, attribute = name.partition(":")
    with working_directory_importable():
        path, digest, source = _source(name, field)
        module = sys.modules.get(module_name)
        try:
            if module is None or _loaded.get(module_name) != digest:
                importlib.import_module(module_name.rpartition(".")[0] or "sys")
                spec = importlib.util.spec_from_file_location(module_name, path)
                module = module or importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
                sys.modules[module_name] = module
                exec(compile(source, path, "exec"), vars(module))
                _loaded[module_name] = digest
        except Exception as error:
            sys.modules.pop(module_name, None)
            raise OptionError(
                f"{field}='train:{name}': {module_name} cannot be imported: "
                f"{type(error).__name__}: {error}. Correct it."
            ) from error
    function = getattr(module, attribute, None)
    if not callable(function):
        functions = [known for known, value in vars(module).items() if callable(value)]
        raise OptionError(
            f"{field}='train:{name}': {path} has no function {attribute!r}."
            f"{did_you_mean(attribute, functions)} Define {attribute}(env, steps, seed), which "
            "returns a policy."
        )
    return function, digest


_loaded: dict[str, str] = {}  # the digest of the source that a module has run


def _source(name: str, field: str) -> tuple[str, str, bytes]:
    """The path, the digest and the bytes of a module's source. Imports nothing."""
    module = name.partition(":")[0]
    path = path_of(module)
    if not path or not path.endswith(".py"):
        raise OptionError(
            f"{field}='train:{name}': there is no Python module {module!r}. It must be "
            "train:module:function, with the module in the working directory or installed."
        )
    source = Path(path).read_bytes()
    return path, f"sha256:{hashlib.sha256(source).hexdigest()}", source


def path_of(module: str) -> str | None:
    """The file of a module or a package; None if there is none. Imports nothing."""
    places: Any = None
    found: Any = None
    with working_directory_importable():
        for end in (i for i, letter in enumerate(f"{module}.") if letter == "."):
            found = importlib.machinery.PathFinder.find_spec(module[:end], places)
            if found is None:
                return None
            places = found.submodule_search_locations
    path: str | None = found.origin
    return path


@contextlib.contextmanager
def working_directory_importable() -> Iterator[None]:
    """Modules in the working directory can be imported inside the block."""
    folder = os.getcwd()
    sys.path.insert(0, folder)
    try:
        yield
    finally:
        sys.path.remove(folder)
