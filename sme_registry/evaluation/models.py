"""Models of other libraries as functions of observations: PyTorch, Stable-Baselines3, ONNX.

PyTorch is never imported to recognise a module or a tensor: who has one has imported it. SB3's
`predict` clips a Gaussian's mean, which hides the share that is clipped: its plain networks are
called directly. A .zip names only the class of its policy, so `saved_sb3` adds the algorithm's. For
other files it follows from the policy's class, or from fields that only one algorithm saves.
Both kinds of files can run code or take all memory: open only those whose author you trust.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sme_registry.errors import PolicyError, did_you_mean
from sme_registry.io import import_object, require_packages
from sme_registry.spec.sme_spec import ACTION_RANGES, ActionRange
from sme_registry.task.task import Observation

Act = Callable[[Observation], Any]


class Interface(NamedTuple):
    """The widths of observations and actions that a task needs of a policy."""

    observation_dim: int
    action_dim: int
    description: str  # what has these widths, such as "state_dim=3, action_dim=2"
    hint: str = ""  # see `Policy`

    def check(self, policy: str, **shapes: tuple[int, ...] | None) -> None:
        """Raise `PolicyError` if a known shape of `observations` or `actions` is another."""
        widths = {"observations": self.observation_dim, "actions": self.action_dim}
        for what, shape in shapes.items():
            if shape not in (None, (widths[what],)):
                raise PolicyError(
                    f"{policy}: its {what} have shape {shape}: must be {(widths[what],)} for "
                    f"{self.description}. Evaluate it on the task that it was trained or prepared "
                    "for."
                )


# PyTorch


def _torch() -> Any:
    """PyTorch, if it is imported."""
    return sys.modules.get("torch")


def is_module(policy: Any) -> bool:
    nn = sys.modules.get("torch.nn")
    return nn is not None and isinstance(policy, nn.Module)


class ModulePredictor:
    """A module's actions, in evaluation mode and without gradients."""

    def __init__(self, module: Any) -> None:
        self.module = module

    def __call__(self, observations: Observation) -> Any:
        """Actions `[B, A]`, a tensor; PolicyError if the module returns anything else."""
        torch, module = _torch(), self.module
        parameter = next(module.parameters(), None)
        x = torch.as_tensor(observations, device=device_of(module))
        with evaluating(module), torch.no_grad():
            returned = module(x if parameter is None else x.to(parameter.dtype))
        if not isinstance(returned, torch.Tensor):
            raise PolicyError(
                f"policy {type(module).__name__!r}: returns an object of type "
                f"{type(returned).__name__}: must be one tensor of deterministic actions. Give a "
                "function that returns them alone, such as "
                "`lambda o: actor(torch.as_tensor(o))[0]` for a tuple, or "
                "`lambda o: actor(torch.as_tensor(o)).mean` for a distribution."
            )
        return returned


def of_module(module: Any) -> dict[str, Any]:
    """How a module acts: fields of `Policy`."""
    act = ModulePredictor(module)
    return {"act": act, "hidden": _hidden_layers(act, module)}


def _hidden_layers(act: Act, module: Any) -> Callable[[Observation], list[Any] | None]:
    """The outputs of a module's hidden layers: the inputs of its linear layers but the first."""
    linear = [part for part in module.modules() if isinstance(part, _torch().nn.Linear)]

    def hidden(observations: Observation) -> list[Any] | None:
        calls: list[tuple[Any, Any]] = []

        def keep(layer: Any, arguments: tuple[Any, ...]) -> None:
            calls.extend((layer, x) for x in arguments[:1])

        hooks = [part.register_forward_pre_hook(keep) for part in linear]
        try:
            act(observations)
        finally:
            for hook in hooks:
                hook.remove()
        inputs = _chain(calls, observations.shape)
        return None if inputs is None else [without_tensor(x) for x in inputs[1:]]

    return hidden


def _chain(calls: list[tuple[Any, Any]], observed: tuple[int, ...]) -> list[Any] | None:
    """The different inputs of linear layers, in order; None if the layers form no chain."""
    if len({layer for layer, _ in calls}) < len(calls):
        return None
    links: list[tuple[Any, list[int]]] = []  # an input, and the widths of the layers that take it
    for layer, x in calls:
        # Two heads of a network, such as mean and spread, have the same input.
        widths = next((widths for known, widths in links if known is x), None)
        if widths is None:
            links.append((x, widths := []))
        widths.append(layer.out_features)
    rows, entries = observed
    before = [[entries], *(widths for _, widths in links)]
    linked = all(
        any(tuple(x.shape) == (rows, width) for width in widths)
        for (x, _), widths in zip(links, before, strict=False)
    )
    return [x for x, _ in links] if linked else None


def without_tensor(returned: Any) -> Any:
    """What a policy returned; a tensor, on any device, with or without gradient, as an array."""
    torch = _torch()
    tensor_type: Any = getattr(torch, "Tensor", ())  # none while PyTorch is being imported
    if not isinstance(returned, tensor_type):
        return returned
    tensor = returned.detach().cpu()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()


def advice_on(error: Exception) -> str:
    """A sentence on a function that failed because it expects a tensor; else empty."""
    if _torch() is None or "ndarray" not in str(error):
        return ""
    return " Observations are NumPy arrays: `torch.as_tensor(observations)` is the tensor of them."


def device_of(module: Any) -> Any:
    parameter = next(module.parameters(), None)
    return "cpu" if parameter is None else parameter.device


@contextlib.contextmanager
def evaluating(module: Any) -> Iterator[None]:
    """Evaluation mode; afterwards each part is in the mode that it had."""
    before = [(part, part.training) for part in module.modules()]
    module.eval()
    try:
        yield
    finally:
        for part, training in before:
            part.training = training


# Stable-Baselines3 and what has its interface


def of_sb3(model: Any, interface: Interface) -> dict[str, Any]:
    """How a model acts: fields of `Policy`; a plain SB3 model before its actions are clipped."""
    spaces = {"observations": "observation_space", "actions": "action_space"}
    shapes = {what: getattr(getattr(model, s, None), "shape", None) for what, s in spaces.items()}
    interface.check("policy", **shapes)
    normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    if getattr(normaliser, "norm_obs", False):
        raise PolicyError(
            "policy: it was trained on observations normalised by VecNormalize, which an "
            "evaluation does not apply. Pass a callable: "
            "lambda obs: model.predict(vec_normalize.normalize_obs(obs), deterministic=True)[0]."
        )
    network = torch_policy(model)
    if network is None:
        begin = functools.partial(_stateful, model)
        return {"act": lambda observations: begin()(observations), "episodes": begin}

    def act(observations: Observation) -> Any:
        torch = _torch()
        with evaluating(network), torch.no_grad():
            batch = torch.as_tensor(observations, device=network.device)
            chosen = network._predict(batch, deterministic=True).cpu().numpy()
        return network.unscale_action(chosen) if network.squash_output else chosen

    return {"act": act, "hidden": _hidden_layers(act, network)}


def torch_policy(model: Any) -> Any:
    """The PyTorch policy that SB3's own `predict` calls; None if a model predicts otherwise."""
    policies = sys.modules.get("stable_baselines3.common.policies")
    models = sys.modules.get("stable_baselines3.common.base_class")
    if policies is None or models is None:  # not imported: not an SB3 model
        return None
    network, predict = getattr(model, "policy", model), getattr(type(model), "predict", None)
    standard = (models.BaseAlgorithm.predict, policies.BasePolicy.predict)
    is_plain = (
        predict in standard
        and isinstance(network, policies.BasePolicy)
        and type(network).predict is policies.BasePolicy.predict
    )
    return network if is_plain else None


def _stateful(model: Any) -> Act:
    """A model at the start of episodes: its state is kept from call to call, by row."""
    state: dict[str, Any] = {}

    def act(observations: Observation) -> Any:
        predicted = model.predict(observations, deterministic=True, **state)
        if not isinstance(predicted, tuple):
            return predicted
        if predicted[1] is not None:
            state["state"] = predicted[1]
        return predicted[0]

    return act


_LOW: dict[ActionRange, float] = {"unit": 0.0, "symmetric": -1.0}


def action_range_of(model: Any) -> ActionRange:
    """The action range of a model's action space; "unit" if it has no space."""
    space = getattr(model, "action_space", None)
    if space is None:
        return "unit"
    with contextlib.suppress(AttributeError):
        for range_, low in _LOW.items():
            if np.all(space.low == low) and np.all(space.high == 1.0):
                return range_
    raise PolicyError(
        f"policy: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of them, or pass a callable that rescales its actions."
    )


_FIELD = "sme_algorithm"  # of a .zip that `saved_sb3` wrote: module:class
_NAMES = ("PPO", "A2C", "SAC", "TD3", "DDPG")

# By the module of the policy's class. DDPG has TD3's policy and loads as TD3.
_ALGORITHMS = {
    "stable_baselines3.sac.policies": "stable_baselines3:SAC",
    "stable_baselines3.td3.policies": "stable_baselines3:TD3",
    "sb3_contrib.ars.policies": "sb3_contrib:ARS",
    "sb3_contrib.common.recurrent.policies": "sb3_contrib:RecurrentPPO",
    "sb3_contrib.crossq.policies": "sb3_contrib:CrossQ",
    "sb3_contrib.tqc.policies": "sb3_contrib:TQC",
    "sbx.crossq.policies": "sbx:CrossQ",
    "sbx.ppo.policies": "sbx:PPO",
    "sbx.sac.policies": "sbx:SAC",
    "sbx.td3.policies": "sbx:TD3",
    "sbx.tqc.policies": "sbx:TQC",
}
# For the policy of all actor-critics, by a field that the algorithm saves; the first match decides.
_ACTOR_CRITIC = "stable_baselines3.common.policies"
_ACTOR_CRITICS = {
    "clip_range": "stable_baselines3:PPO",
    "cg_max_steps": "sb3_contrib:TRPO",
    "gae_lambda": "stable_baselines3:A2C",
}


def load_sb3(path: str | os.PathLike[str], algorithm: str | None = None) -> Any:
    """Load a model that Stable-Baselines3 saved (.zip), on the CPU and without its environment.

    Loading can run code of the file's author. `algorithm` is its class, such as "PPO" or
    "sb3_contrib:TQC". None reads it from the file: of `sme train`, of a study, or of an algorithm
    of stable-baselines3, sb3-contrib or sbx (a DDPG loads as TD3, which acts equally).
    """
    path = Path(path)
    fields = _saved_fields(path)
    packages = {"stable_baselines3": "Stable-Baselines3", "torch": "PyTorch"}
    require_packages(f"loading {path}", packages, "train")
    name = _algorithm_of(path, fields) if algorithm is None else _full_name(algorithm)
    model_class = import_object(name, "algorithm", PolicyError)
    if not hasattr(model_class, "load"):
        raise PolicyError(
            f"algorithm={name!r}: must be a class with a method `load`, like those of "
            "Stable-Baselines3."
        )
    try:
        # Otherwise the replay buffer is allocated at its full size, though acting never uses it.
        return model_class.load(path, device="cpu", custom_objects={"buffer_size": 1})
    except Exception as error:
        raise PolicyError(
            f"{path}: cannot be loaded as a model of {name}: {type(error).__name__}: {error}. If "
            "it is of another algorithm, give its class (`sme evaluate --algorithm`, in Python "
            "algorithm=). Otherwise save it again with the installed packages, or load it yourself "
            "and pass the model."
        ) from error


def saved_sb3(model: Any) -> bytes:
    """The .zip of a model, with the name of its class for `load_sb3`."""
    setattr(model, _FIELD, f"{type(model).__module__}:{type(model).__qualname__}")
    archive = io.BytesIO()
    model.save(archive)
    return archive.getvalue()


def _algorithm_of(path: Path, fields: dict[str, Any]) -> str:
    """The class of a saved model, `module:class`."""
    recorded = fields.get(_FIELD)
    if isinstance(recorded, str) and ":" in recorded:
        return recorded
    policy_class = fields.get("policy_class")
    module = policy_class.get("__module__") if isinstance(policy_class, dict) else None
    name = _ALGORITHMS.get(str(module))
    if module == _ACTOR_CRITIC:
        name = next((name for field, name in _ACTOR_CRITICS.items() if field in fields), None)
    if name is None:
        policy = f" (its policy is of {module})" if module else ""
        raise PolicyError(
            f"{path}: does not tell its algorithm{policy}. Give the algorithm's class, such as PPO "
            "or sb3_contrib:TQC (`sme evaluate --algorithm`, in Python algorithm=), or load it "
            "yourself and pass the model."
        )
    return name


def _full_name(algorithm: str) -> str:
    if ":" in algorithm:
        return algorithm
    if algorithm.upper() not in _NAMES:
        raise PolicyError(
            f"algorithm={algorithm!r:.80}: must be one of {', '.join(_NAMES)}, or module:Class "
            f"such as sb3_contrib:TQC.{did_you_mean(algorithm, _NAMES)}"
        )
    return f"stable_baselines3:{algorithm.upper()}"


def _saved_fields(path: Path) -> dict[str, Any]:
    """A saved model's fields by name. Reads JSON only and runs no code."""
    check_exists(path, "a saved model (.zip)")
    try:
        with zipfile.ZipFile(path) as archive:
            fields = json.loads(archive.read("data"))
    except (OSError, zipfile.BadZipFile, KeyError, ValueError):
        fields = None
    if not isinstance(fields, dict):
        raise PolicyError(
            f"{path}: not a model that Stable-Baselines3 saved. Give the .zip that `model.save` "
            "wrote, or in Python a callable."
        )
    return fields


def check_exists(path: Path, what: str) -> None:
    if not path.is_file():
        raise PolicyError(f"{path} does not exist. Give the path of {what}.")


# ONNX

ACTION_RANGE = "action_range"  # a field of a file's metadata: "unit" or "symmetric"


def load_onnx(path: Path, interface: Interface) -> OnnxNetwork:
    """Load an ONNX file's network, on one thread of the CPU: a function of observations."""
    check_exists(path, "an .onnx file")
    session = start_session(path)
    ends = {"input": session.get_inputs(), "output": session.get_outputs()}
    for (what, tensors), width in zip(ends.items(), interface[:2], strict=True):
        shape = tensors[0].shape if len(tensors) == 1 else []
        # A length that is not a number is dynamic, and known only when the network runs.
        fits = len(shape) == 2 and not isinstance(shape[0], int)
        fits = fits and (not isinstance(shape[1], int) or shape[1] == width)
        if not fits or tensors[0].type != "tensor(float)":
            actual = ", ".join(f"{tensor.name} {tensor.type} {tensor.shape}" for tensor in tensors)
            raise PolicyError(
                f"{path}: its {what}s are {actual or 'none'}: must be one tensor(float) "
                f"[batch, {width}] for {interface.description}, the batch of any size. Evaluate it "
                "on the task it was trained for, and export it with a dynamic batch axis."
            )
    return OnnxNetwork(session, path)


class OnnxNetwork:
    def __init__(self, session: Any, path: Path) -> None:
        self._session, self._input = session, session.get_inputs()[0].name
        self.path = path
        recorded = session.get_modelmeta().custom_metadata_map.get(ACTION_RANGE)
        self.action_range = recorded if recorded in ACTION_RANGES else None

    def __call__(self, observations: Observation) -> Any:
        return self._session.run(None, {self._input: observations})[0]


def start_session(model: Path | bytes, optimized: Path | None = None) -> Any:
    """A session of onnxruntime for a file or its content; `optimized` is where it writes it.

    What it writes has no operations on constants, and is of standard operators.
    """
    name = "model" if isinstance(model, bytes) else str(model)
    require_packages(f"running {name}", {"onnxruntime": "onnxruntime"}, "onnx")
    # From version 1.31 on its telemetry is on by default; an evaluation must not send any.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised instead
    if optimized is not None:
        options.optimized_model_filepath = os.fspath(optimized)
        basic = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
        options.graph_optimization_level = basic
    try:
        return onnxruntime.InferenceSession(
            model if isinstance(model, bytes) else os.fspath(model),
            options,
            providers=["CPUExecutionProvider"],
        )
    except Exception as error:
        raise PolicyError(
            f"{name}: not a network that onnxruntime can load: {error}. Export it again "
            "with an opset from 13 to 23, or pass a callable."
        ) from error
