"""`FunctionLearner`: a function of any framework that trains.

    def train(env, steps, seed):            # `train:module:train` in `sme train -a` and in plans
        ...                                 # takes at most `steps` steps of `env`
        return policy                       # from observations [B, O] to actions [B, A]

`env` is a Gymnasium environment of one task, with the exact regret of each step in its info.
Hyperparameters are keyword arguments. The policy acts in the environment's action space; a model
with `predict`, as those of Stable-Baselines3, and a PyTorch module are policies, too. It is
evaluated once, at the end of its training. A function with `yield policy` in it, at any time and as
often as it likes, is evaluated during training too; the last policy is that of the run.
"""

from __future__ import annotations

import importlib.util
import inspect
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium

from sme_registry.envs import SMEEnv
from sme_registry.envs.episodes import info_of_envs
from sme_registry.errors import OptionError, PolicyError, did_you_mean
from sme_registry.evaluation.models import saved_sb3
from sme_registry.io import sha256_of, write_atomically
from sme_registry.io.system import module_file, working_directory_importable
from sme_registry.spec.document import StrictModel
from sme_registry.training.algorithms import arguments_of, parse_uses
from sme_registry.training.learn import Learner, Run, Steps, Watch

_loaded: dict[str, str] = {}  # the digest of the source that a module has run
_in_memory: dict[str, Callable[..., Any]] = {}  # functions of a notebook, by their names


def settings(name: str) -> type[StrictModel]:
    """The arguments of a function, without the environment, steps and seed."""
    return arguments_of(load_function(name)[0], passed=3)


def source_of(uses: str) -> str | None:
    """The digest of the source of `train:module:name`, which is not imported; None of any other."""
    kind, name = parse_uses(uses)
    return sha256_of(_source(name)[1]) if kind == "train" else None


def keep_in_memory(function: Callable[..., Any]) -> str:
    """The `uses` of a function that no module file has, such as one of a notebook, in this process.

    The digest of its source is that of the function alone.
    """
    name = f"__main__:{function.__name__}"
    try:
        inspect.getsource(function)
    except OSError:
        raise OptionError(
            f"{name}: has no source, by which its results are known. Define it in a file."
        ) from None
    _in_memory[name] = function
    return f"train:{name}"


def is_in_memory(uses: str) -> bool:
    """Whether the function of `uses` is only in this process."""
    return parse_uses(uses)[1] in _in_memory


def check_signature(
    name: str, function: Callable[..., Any], hyperparameters: Mapping[str, Any]
) -> None:
    """Check that a function can be called with an environment, steps, a seed and these."""
    try:
        inspect.signature(function).bind(None, 1, 0, **hyperparameters)
    except TypeError as error:
        raise OptionError(
            f"algorithm='train:{name}': cannot be called with an environment, steps, a seed and "
            f"the hyperparameters {sorted(hyperparameters)}: {error}. Define "
            f"{name.partition(':')[2]}(env, steps, seed), and hyperparameters by name."
        ) from None


def load_function(name: str) -> tuple[Callable[..., Any], str]:
    """The function `module:function` of the present source, and the source's digest.

    The source is run again where it has changed, so what runs is what the digest says.
    """
    module_name, _, attribute = name.partition(":")
    with working_directory_importable():
        path, source = _source(name)
        digest = sha256_of(source)
        if name in _in_memory:
            return _in_memory[name], digest
        module = sys.modules.get(module_name)
        try:
            if module is None or _loaded.get(module_name) != digest:
                if module is None:
                    spec: Any = importlib.util.find_spec(module_name)
                    module = importlib.util.module_from_spec(spec)
                sys.modules[module_name] = module
                exec(compile(source, path, "exec"), vars(module))
                _loaded[module_name] = digest
        except Exception as error:
            sys.modules.pop(module_name, None)
            raise OptionError(
                f"algorithm='train:{name}': {module_name} cannot be imported: "
                f"{type(error).__name__}: {error}. Correct it."
            ) from error
    function = getattr(module, attribute, None)
    if not callable(function):
        functions = [known for known, value in vars(module).items() if callable(value)]
        raise OptionError(
            f"algorithm='train:{name}': {path} has no function {attribute!r}."
            f"{did_you_mean(attribute, functions)} Define {attribute}(env, steps, seed), which "
            "returns a policy."
        )
    return function, digest


def _source(name: str) -> tuple[str, bytes]:
    """The path and the bytes of a module's source, which is not imported."""
    module = name.partition(":")[0]
    if name in _in_memory:
        return module, inspect.getsource(_in_memory[name]).encode()
    path = module_file(module)
    if not path or not path.endswith(".py"):
        raise OptionError(
            f"algorithm='train:{name}': there is no Python module {module!r}. It must be "
            "train:module:function, with the module in the working directory or installed."
        )
    return path, Path(path).read_bytes()


class FunctionLearner(Learner):
    """A function `train(env, steps, seed) -> policy` in its environment."""

    def __init__(self, name: str, run: Run) -> None:
        super().__init__(name, run)
        self._named = f"algorithm='train:{name}'"
        self._function, self.source = load_function(name)
        check_signature(name, self._function, self.hyperparameters)
        self.yields_policies = inspect.isgeneratorfunction(self._function)
        self.only_at_the_end = not self.yields_policies
        env = SMEEnv(run.document, action_range=run.action_range)
        self._env = _LimitedEnv(env, run.steps, self._named)
        self.model: Any = None

    @property
    def steps(self) -> int:
        return self._env.steps

    @property
    def total(self) -> int:
        return self.run.steps

    @property
    def seconds(self) -> float:
        return self._env.seconds

    def learn(self, watch: Watch) -> None:
        run, self._env.on_steps, self._env.on_reset = self.run, watch.on_steps, watch.on_reset
        self._env.reset(seed=run.seed)  # so that episodes without a seed are reproducible
        with working_directory_importable():
            trained = self._function(self._env, run.steps, run.seed, **self.hyperparameters)
            for policy in trained if self.yields_policies else ():
                self.model = self._checked(policy)
                watch.on_policy()
        self.model = self._checked(self.model if self.yields_policies else trained)

    def _checked(self, model: Any) -> Any:
        is_policy = callable(model) or hasattr(model, "predict")
        if not is_policy or isinstance(model, type):
            document = self.run.document
            raise PolicyError(
                f"{self._named}: returned {model!r:.80}: must be a policy. Return a function "
                f"from observations [B, {document.observation_dim}] to actions "
                f"[B, {document.action_dim}], or a model with predict, as those of "
                "Stable-Baselines3."
            )
        return model

    def save(self, path: Path) -> None:
        kinds = sys.modules.get("stable_baselines3.common.base_class")
        if kinds is not None and isinstance(self.model, kinds.BaseAlgorithm):
            write_atomically(path, saved_sb3(self.model))

    def close(self) -> None:
        self._env.close()


class _LimitedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """An environment that takes no more than its steps, and counts them and their CPU seconds."""

    def __init__(self, env: SMEEnv, limit: int, named: str) -> None:
        super().__init__(env)
        self._limit, self._named = limit, named
        self.steps, self.seconds = 0, 0.0
        self.on_steps: Callable[[Steps], None] = lambda steps: None
        self.on_reset: Callable[[], None] = lambda: None

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self.on_reset()
        return self.env.reset(**options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.steps >= self._limit:
            raise PolicyError(
                f"{self._named}: takes more than {self._limit:,} steps: must stop at the steps "
                "that it is given. Choose rollouts and evaluations of your own that fit, or give "
                "more steps."
            )
        begun = time.thread_time()
        result = self.env.step(action)
        self.seconds += time.thread_time() - begun
        self.steps += 1
        _, reward, terminated, truncated, info = result
        ended = [terminated or truncated]
        self.on_steps(Steps([float(reward)], info_of_envs([info]), [terminated], ended))
        return result
