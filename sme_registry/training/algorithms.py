"""`BACKENDS`: what the names in `uses` stand for, in `sme train` and in the cells of a study.

    PPO, TD3, …            an algorithm of Stable-Baselines3, in any case, or one of ours for tasks
                           with `safety`; the agents of a team share one model
    independent:PPO        the same with one model for each agent of a team
    jax:PPO, …             the same in JAX, with its environment in one program
    offline:bc, …          learns from a data set
    reference:linear, …    a reference policy, which learns nothing
    train:module:name      a function of any framework, `train(env, steps, seed) -> policy`
    an entry point         of the group `sme_registry.algorithms`, in an installed package
    module:name            imported, from this folder or installed

An entry point or `module:name` is either a class like those of Stable-Baselines3
(`sb3_contrib:TQC`), or a function that returns a model; see `models`. Of `train:…` see `functions`.

Hyperparameters are JSON values. Importing this module does not import PyTorch.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import inspect
import io
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field, create_model

from sme_registry.datasets import documents
from sme_registry.envs.arguments import check_has_limits
from sme_registry.errors import OptionError, SMEError, SpecError, UnknownNameError, did_you_mean
from sme_registry.evaluation.references import OLD_NAMES, POLICIES
from sme_registry.io import choice, import_object, require_packages
from sme_registry.io.system import missing_dependency, module_file
from sme_registry.spec import SMESpec, StreamSpec, StudyPlan
from sme_registry.spec.document import Integer, Real, StrictModel
from sme_registry.spec.study import PlannedCell

if TYPE_CHECKING:
    from sme_registry.training.learn import Learner, Run

ENTRY_POINTS = "sme_registry.algorithms"
_PLACES = {  # the modules of algorithms with names of their own
    **dict.fromkeys(("TD3", "SAC", "DDPG", "PPO", "A2C"), "stable_baselines3"),
    **dict.fromkeys(("PPOLagrangian", "PPOProjection"), "sme_registry.sb3"),  # need limits
}
# Arguments of an algorithm's constructor that are not hyperparameters.
_RESERVED = ("self", "policy", "env", "seed", "device", "verbose", "tensorboard_log")
# Arguments of a policy's constructor that the algorithm passes.
_PASSED = ("self", "observation_space", "action_space", "lr_schedule")

Document = SMESpec | StreamSpec
Kind = Literal["task", "team", "stream"]
_KINDS: dict[Kind, str] = {
    "task": "a task of a single agent",
    "team": "the task of a team",
    "stream": "a stream",
}


@dataclass(frozen=True)
class Backend:
    """The learners of one prefix of `uses`: a new back-end is a module, and a row of `BACKENDS`.

    Functions and classes are `module:name`, and imported when they are needed.
    """

    settings: str  # from a learner's name to its hyperparameters' model
    learns: tuple[Kind, ...]
    learner: str = ""  # its `Learner`; empty for what a study runs in another way
    names: tuple[str, ...] = ()  # its learners; empty where each name is one
    check: str = ""  # raises for a task or stream that it cannot learn for another reason
    several: bool = False  # whether it learns in several environments at once
    one_thread: bool = False  # whether PyTorch has one thread meanwhile
    title: str = ""  # whose implementation of the same algorithms it is: then a value of `agents`
    device: str = ""  # from the name of a device, or None, to the one that it computes on
    in_programs: bool = False  # whether its cells share programs; see `studies.programs`
    own_checkpoint: bool = False  # whether only it reads its checkpoints, which are no models
    packages: tuple[str, ...] = ()  # whose versions its numbers depend on too


_HERE = "sme_registry.training"
BACKENDS: dict[str, Backend] = {
    "sb3": Backend(  # also what others wrote for its environments; has no prefix
        settings=f"{_HERE}.algorithms:sb3_settings",
        learns=("task", "team", "stream"),
        learner=f"{_HERE}.models:SB3Learner",
        several=True,
        one_thread=True,
        title="Stable-Baselines3",
    ),
    "independent": Backend(
        settings=f"{_HERE}.algorithms:independent_settings",
        learns=("team",),
        learner=f"{_HERE}.independent:IndependentLearner",
        several=True,
        one_thread=True,
    ),
    "jax": Backend(
        settings="sme_registry.jax.run:hyperparameters_of",
        learns=("task", "stream"),
        learner=f"{_HERE}.jax_agents:JAXLearner",
        names=("PPO", "TD3", "SAC"),
        check="sme_registry.jax.task:check_supported",
        one_thread=True,
        title="JAX",
        device="sme_registry.jax:find_device",
        in_programs=True,
        own_checkpoint=True,
        packages=("jaxlib",),
    ),
    "train": Backend(
        settings=f"{_HERE}.functions:settings",
        learns=("task",),
        learner=f"{_HERE}.functions:FunctionLearner",
    ),
    "offline": Backend(
        settings=f"{_HERE}.algorithms:offline_settings",
        learns=("task",),
        names=tuple(documents.ALGORITHMS),
    ),
    "reference": Backend(
        settings=f"{_HERE}.algorithms:no_settings",
        learns=("task", "team"),
        names=(*POLICIES, *OLD_NAMES),
    ),
}
AGENTS = tuple(kind for kind, backend in BACKENDS.items() if backend.title)
_DEFAULT = AGENTS[0]


@dataclass(frozen=True)
class Entry:
    """What a name in `uses` stands for: a learner of a back-end, `name` without the prefix."""

    kind: str
    name: str

    @property
    def backend(self) -> Backend:
        return BACKENDS[self.kind]

    @property
    def uses(self) -> str:
        return self.name if self.kind == "sb3" else f"{self.kind}:{self.name}"

    def settings(self) -> type[StrictModel]:
        """The model of its hyperparameters; raises if it is not installed here."""
        model: type[StrictModel] = imported(self.backend.settings)(self.name)
        return model

    def check_learns(self) -> None:
        """Raise if it learns from data, or not at all."""
        if not self.backend.learner:
            raise OptionError(
                f"algorithm={self.uses!r}: learns in no environment. Use it in a study."
            )

    def learner(self, run: Run) -> Learner:
        """What learns in this run."""
        learner: Learner = imported(self.backend.learner)(self.name, run)
        return learner

    def check_task(self, document: Document) -> None:
        """Raise if it cannot learn a task or live in a stream."""
        backend, spec = self.backend, document.specs[0]
        kind: Kind = "task" if spec.team is None else "team"
        kind = "stream" if isinstance(document, StreamSpec) else kind
        if kind not in backend.learns:
            known = " or ".join(_KINDS[each] for each in backend.learns)
            raise SpecError(
                f"algorithm={self.uses!r}: learns {known}, and this is {_KINDS[kind]}. Choose "
                "another algorithm, such as PPO."
            )
        if _PLACES.get(self.name) == "sme_registry.sb3":
            check_has_limits(self.name, spec)
        if backend.check:
            imported(backend.check)(document)

    @contextlib.contextmanager
    def surroundings(self) -> Iterator[None]:
        """Where it learns: without warnings of libraries, and with one thread of PyTorch."""
        with quiet(), one_thread() if self.backend.one_thread else contextlib.nullcontext():
            yield


def imported(name: str) -> Any:
    """What `module:name` is; the error for a missing package names its extra."""
    module, _, attribute = name.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ModuleNotFoundError as error:
        raise missing_dependency(error) or error from None


def parse_uses(uses: str) -> tuple[str, str]:
    """Kind and name of a learner: `("jax", "PPO")` for "jax:PPO"; without a prefix "sb3"."""
    kind, colon, name = uses.partition(":")
    # `train:make` is a function of a module `train` that returns a model.
    if colon and kind in BACKENDS and (kind != "train" or ":" in name):
        return kind, name
    return "sb3", uses


def backend_of(uses: str) -> Backend:
    return BACKENDS[parse_uses(uses)[0]]


def find(uses: str, field: str = "algorithm") -> Entry:
    """The entry of a name, in any case."""
    kind, name = parse_uses(uses)
    known = {"sb3": _PLACES, "independent": _PLACES}.get(kind, BACKENDS[kind].names)
    for exact in known:
        if exact.casefold() == name.casefold():
            return Entry(kind, exact)
    backend = BACKENDS[kind]
    if backend.names:
        hint = f" Other algorithms run without {backend.title}." if backend.title else ""
        raise UnknownNameError(
            f"{field}={uses!r}: must be one of {', '.join(f'{kind}:{each}' for each in known)}."
            f"{hint}{did_you_mean(name, known)}"
        )
    return Entry(kind, name)


def default_algorithm(document: SMESpec | StreamSpec) -> str:
    """The algorithm used by default: TD3, and PPO for a team."""
    return "TD3" if document.specs[0].team is None else "PPO"


def full_name(uses: str, agents: str | None = None) -> str:
    """The exact name of an algorithm in any case, in the implementation of `agents`, if given."""
    return find(uses if agents is None else with_agents(uses, agents)).uses


def with_agents(uses: str, agents: str) -> str:
    """An algorithm in the implementation of `agents`, if another has it."""
    choice("agents", agents, AGENTS)
    kind, name = parse_uses(uses)
    uses = name if kind in AGENTS else uses
    return uses if agents == _DEFAULT else f"{agents}:{uses}"


def needs_device(option: str, value: object, others: str) -> OptionError:
    """The error for an option of agents on a device, where none is trained."""
    kinds = [kind for kind, backend in BACKENDS.items() if backend.device]
    titles = " or ".join(BACKENDS[kind].title for kind in kinds)
    example = f"{kinds[0]}:{BACKENDS[kinds[0]].names[0]}"
    return OptionError(
        f"{option}={value!r}: is for agents in {titles}{others}. Leave it out, or use --agents "
        f'{" or ".join(kinds)} (in Python, agents="{kinds[0]}"; in a plan, "uses": "{example}").'
    )


def short_name(uses: str) -> str:
    """What figures and reports call an algorithm: `TQC` for `sb3_contrib:TQC`."""
    return uses.rpartition(":")[2]


def folder_name(uses: str) -> str:
    """What default folders call an algorithm: its short name, and `jax-PPO` for `jax:PPO`."""
    kind, _ = parse_uses(uses)
    return f"{kind}-{short_name(uses)}" if kind in AGENTS[1:] else short_name(uses)


def check_hyperparameters(
    uses: str,
    hyperparameters: Mapping[str, Any],
    field: str = "hyperparameters",
    others: Iterable[str] = (),
) -> None:
    """Check that an algorithm is here and has hyperparameters of these names and values.

    Of Stable-Baselines3 and of modules, values are checked when a model is made. Errors call them
    `field`, and may suggest one of `others`, which the caller has.
    """
    entry = find(uses)
    if entry.kind == "sb3" and entry.name in _PLACES and not hyperparameters:
        require_sb3()  # which takes less time than its import
        return
    model = entry.settings()
    unknown = [name for name in hyperparameters if name not in model.model_fields]
    for name in unknown if model.model_config["extra"] == "forbid" else ():
        raise OptionError(
            f"{field}.{name}: {entry.uses} has no such hyperparameter."
            f"{did_you_mean(name, [*model.model_fields, *others])} Known: "
            f"{', '.join(model.model_fields) or 'none'}."
        )
    try:
        model.from_dict(dict(hyperparameters), field)
    except SpecError as error:
        raise OptionError(str(error)) from None


def check_algorithms(
    plan: StudyPlan,
    planned: Collection[PlannedCell],
    say: Callable[[str], object],
    tolerated: type[SMEError] | tuple[()] = (),
) -> list[str]:
    """Check the algorithms of planned cells, and that they can learn their tasks.

    Says first whose code runs to find them. Returns the messages of errors that are tolerated.
    """
    tasks: dict[str, list[Document]] = {}
    for place in planned:
        tasks.setdefault(place.algorithm, []).append(place.cell.document)
    algorithms = [algorithm for algorithm in plan.algorithms if algorithm.name in tasks]
    names = [parse_uses(algorithm.uses)[1] for algorithm in algorithms]
    modules = dict.fromkeys(name.partition(":")[0] for name in names if ":" in name)
    if here := [module for module in modules if module_file(module)]:
        say(f"This plan runs the code of {', '.join(here)}.")
    messages = []
    for algorithm in algorithms:
        field = f"algorithm {algorithm.name!r}: hyperparameters"
        try:
            for task in tasks[algorithm.name]:
                find(algorithm.uses).check_task(task)
            check_hyperparameters(algorithm.uses, algorithm.hyperparameters, field)
        except tolerated as error:
            messages.append(str(error))
    return messages


def load_algorithm(name: str) -> Any:
    """A class of Stable-Baselines3's kind, or a function that returns a model."""
    require_sb3()  # every model gets its `VecEnv`
    with quiet():
        if name in _PLACES:
            # It imports the deprecated `gym` if that is installed, which prints a long notice.
            with contextlib.redirect_stderr(io.StringIO()):
                return import_object(f"{_PLACES[name]}:{name}", "algorithm", OptionError)
        if ":" not in name:
            return _entry_point(name)
        algorithm = import_object(name, "algorithm", OptionError)
    if not callable(algorithm):
        raise OptionError(
            f"algorithm={name!r}: is of type {type(algorithm).__name__}: must be a class like "
            "those of Stable-Baselines3, or a function from an environment to a learner."
        )
    return algorithm


def _entry_point(name: str) -> Any:
    installed = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    if name not in installed:
        prefixed = [f"{kind}:{one}" for kind, row in BACKENDS.items() for one in row.names]
        known = [*_PLACES, *prefixed, *sorted(installed)]
        raise UnknownNameError(
            f"algorithm={name!r}: must be one of {', '.join(known)}; or module:Class or "
            f"module:function, such as sb3_contrib:TQC.{did_you_mean(name, known)}"
        )
    return import_object(installed[name].value, f"algorithm={name!r}: entry point", OptionError)


def sb3_settings(name: str) -> type[StrictModel]:
    """The arguments of an algorithm's constructor, or of a function that returns a model."""
    algorithm = load_algorithm(name)
    if not (isinstance(algorithm, type) and is_sb3(algorithm)):
        return arguments_of(algorithm, "seed", passed=1)
    aliases: dict[str, Any] = getattr(algorithm, "policy_aliases")  # noqa: B009
    in_policy: Any = arguments_of(aliases[policy_alias(algorithm)], *_PASSED) | None
    model = arguments_of(algorithm, *_RESERVED)
    return create_model(name, __base__=model, policy_kwargs=(in_policy, None))


def independent_settings(name: str) -> type[StrictModel]:
    if not is_on_policy(load_algorithm(name)):
        raise OptionError(
            f"algorithm='independent:{name}': must be an on-policy algorithm, such as "
            "independent:PPO, because the models of a team learn from the same rollouts. Use one "
            f"model for all agents instead: {name}."
        )
    return sb3_settings(name)


def offline_settings(name: str) -> type[StrictModel]:
    """The hyperparameters of an offline learner, and its data set's."""
    return create_model(
        name,
        __base__=documents.ALGORITHMS[name],
        nu=(Annotated[Real, Field(ge=0, le=1)], ...),
        transitions=(Annotated[Integer, Field(ge=1)], 50_000),
        batch_size=(Annotated[Integer, Field(ge=1)], 256),
    )


def no_settings(name: str) -> type[StrictModel]:
    return StrictModel


class _Open(StrictModel):
    model_config = ConfigDict(extra="allow")


def arguments_of(function: Any, *reserved: str, passed: int = 0) -> type[StrictModel]:
    """The arguments of a function, or a class's constructor and those that it passes on to.

    Without those of reserved names, and the first ones, which are `passed`.
    """
    parameters = list(_parameters_of(function).values())
    more = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    fields: dict[str, Any] = {
        each.name: (Any, ... if each.default is each.empty else each.default)
        for each in parameters[passed:]
        if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)
        and each.name not in reserved
        and not each.name.startswith("_")
    }
    return create_model("Hyperparameters", __base__=_Open if more else StrictModel, **fields)


def _parameters_of(function: Any) -> Mapping[str, inspect.Parameter]:
    if not isinstance(function, type):
        return inspect.signature(function).parameters
    parameters: dict[str, inspect.Parameter] = {}
    for owner in function.__mro__:
        if "__init__" not in vars(owner):
            continue
        own = inspect.signature(owner).parameters
        parameters = {**own, **parameters}
        if not any(each.kind is each.VAR_KEYWORD for each in own.values()):
            passed_on = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
            return {name: p for name, p in parameters.items() if p.kind not in passed_on}
    return parameters


def policy_alias(algorithm: Any) -> str:
    """SB3's name of an algorithm's perceptron policy: "MlpPolicy", or "MlpLstmPolicy"."""
    aliases: list[str] = ["MlpPolicy", *algorithm.policy_aliases]
    return next(a for a in aliases if a in algorithm.policy_aliases and a.startswith("Mlp"))


def require_sb3() -> None:
    """Check that Stable-Baselines3 and PyTorch are installed; imports neither."""
    require_packages(
        "training", {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}, "train"
    )


def is_on_policy(algorithm: Any) -> bool:
    """Whether this is an on-policy class of Stable-Baselines3, such as PPO."""
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

    return isinstance(algorithm, type) and issubclass(algorithm, OnPolicyAlgorithm)


def is_sb3(algorithm: Any) -> bool:
    """Whether this is a class of Stable-Baselines3's kind, or a model of one."""
    from stable_baselines3.common.base_class import BaseAlgorithm

    return issubclass(algorithm if isinstance(algorithm, type) else type(algorithm), BaseAlgorithm)


def quiet() -> contextlib.AbstractContextManager[Any]:
    """Hide warnings of libraries, which address their developers and not our users."""
    return warnings.catch_warnings(action="ignore")


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Run PyTorch on one thread; the previous number is restored afterwards."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def default_num_envs(spec: SMESpec, algorithm: Any) -> int:
    return 8 if spec.team is not None and is_on_policy(algorithm) else 1


def nested_hyperparameters(flat: Mapping[str, Any]) -> dict[str, Any]:
    """Hyperparameters whose dotted names are resolved: `policy_kwargs.net_arch` is in a dict."""
    nested: dict[str, Any] = {}
    for name, value in flat.items():
        *parents, last = name.split(".")
        block: Any = nested
        for parent in parents:
            block = block.setdefault(parent, {}) if isinstance(block, dict) else None
        if not all((*parents, last)) or not isinstance(block, dict) or last in block:
            raise OptionError(
                f"hyperparameters.{name}: is not a name, or is set twice. Use one name for each "
                "value, such as policy_kwargs.net_arch."
            )
        block[last] = dict(value) if isinstance(value, Mapping) else value  # the caller's stays
    return nested
