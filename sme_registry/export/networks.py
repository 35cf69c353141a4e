"""`Network`: a policy that writes itself as ONNX, from arrays, PyTorch, or Stable-Baselines3.

A network of arrays has one Gemm and one activation for each layer, and needs no PyTorch. Modules
and functions are traced: PyTorch's other exporter needs another package and is ten times slower.
Of SB3:

    x = clip((o − mean) / √(var + ε), ±clip)    in float64, with VecNormalize
    y = the network's deterministic action
    a = (y + 1)/2                               if y is squashed, or symmetric in [−1, 1]
    a = y                                       otherwise
"""

from __future__ import annotations

import functools
import inspect
import io
import os
import pickle
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sme_registry.errors import PolicyError
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.models import Interface, device_of, evaluating, start_session
from sme_registry.io import require_packages
from sme_registry.spec.sme_spec import ActionRange
from sme_registry.task.task import Observation

if TYPE_CHECKING:
    import torch

INPUT, OUTPUT = "observations", "actions"
_OPSET, _IR_VERSION = 17, 8
_ROWS = 4099  # of a traced batch: a prime, which no layer is wide
_OPERATORS = {"relu": "Relu", "tanh": "Tanh", "sigmoid": "Sigmoid", "elu": "Elu"}
_OTHER_LIBRARIES = "Give networks of other libraries, and linear maps, as a `Perceptron` of arrays."


class Network(NamedTuple):
    """A policy that can be written as ONNX."""

    observation_dim: int
    act: Callable[[Observation], Any]
    to_onnx: Callable[..., bytes]  # with `fixed_rows`, see `traced`


def array_network(perceptron: Perceptron, symmetric: bool) -> Network:
    """A perceptron whose actions are in [−1, 1] if `symmetric`, else in [0, 1]."""

    def act(observations: Any) -> Any:
        actions = perceptron(observations)
        return (actions + 1.0) * 0.5 if symmetric else actions

    def to_onnx(fixed_rows: bool) -> bytes:
        return _to_onnx(perceptron, symmetric)

    return Network(perceptron.observation_dim, act, to_onnx)


def _to_onnx(perceptron: Perceptron, symmetric: bool) -> bytes:
    from onnx import TensorProto, helper

    graph = _Graph()
    x = INPUT
    for W, b, activation in perceptron.layers:
        x = graph.node("Gemm", x, graph.constant(W), graph.constant(b))
        if activation == "silu":
            x = graph.node("Mul", x, graph.node("Sigmoid", x))
        elif activation != "identity":
            x = graph.node(_OPERATORS[activation], x)
    if perceptron.low is not None and perceptron.high is not None:
        x = graph.affine(x, 0.5 * (perceptron.high - perceptron.low), perceptron.low)
    if symmetric:
        x = graph.affine(x, 0.5, 0.0)
    x = graph.node("Clip", x, graph.constant(0.0), graph.constant(1.0))
    graph.nodes.append(helper.make_node("Identity", [x], [OUTPUT]))
    widths = {INPUT: perceptron.observation_dim, OUTPUT: perceptron.action_dim}
    ends = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", width])
        for name, width in widths.items()
    ]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", ends[:1], ends[1:], graph.constants),
        opset_imports=[helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="sme-registry",
    )
    return bytes(model.SerializeToString())


class _Graph:
    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, operator: str, *inputs: str) -> str:
        from onnx import helper

        output = f"x{len(self.nodes)}"
        self.nodes.append(helper.make_node(operator, inputs, [output]))
        return output

    def constant(self, array: Any) -> str:
        from onnx import numpy_helper

        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
        return name

    def affine(self, x: str, scale: Any, low: Any) -> str:
        """low + scale (x + 1)."""
        x = self.node("Add", x, self.constant(1.0))
        return self.node("Add", self.node("Mul", x, self.constant(scale)), self.constant(low))


def torch_network(policy: Any, interface: Interface, symmetric: bool) -> Network:
    """A module or function from observations to actions in [−1, 1] if `symmetric`, else [0, 1]."""
    require_packages("exporting a function", {"torch": "PyTorch"}, "train")
    module = _unit_policy(getattr(policy, "_orig_mod", policy), symmetric)  # not `torch.compile`'s
    _check_output(policy, module, interface)

    def act(observations: Observation) -> Any:
        import torch

        with evaluating(module), torch.no_grad():
            actions = module.unclipped(torch.as_tensor(observations, device=device_of(module)))
        return actions.cpu().numpy()

    width = interface.observation_dim
    return Network(width, act, functools.partial(traced, module, width))


def traced(module: Any, width: int, *, fixed_rows: bool = False) -> bytes:
    """A module from observations `[B, width]` to actions as ONNX, in evaluation mode.

    PyTorch computes sizes from shapes, where only the batch varies, unless it writes the model for
    a number of rows (`fixed_rows`). That number then stands for any.
    """
    import torch

    stream: Any = io.BytesIO()
    rows = torch.zeros((_ROWS, width), device=device_of(module))
    batch = {} if fixed_rows else {INPUT: {0: "batch"}, OUTPUT: {0: "batch"}}
    # Warnings of tracing are for PyTorch's developers: the file is compared with the module.
    with evaluating(module), warnings.catch_warnings(action="ignore"), torch.no_grad():
        try:
            torch.onnx.export(
                module,
                (rows,),
                stream,
                dynamo=False,
                opset_version=_OPSET,
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_axes=batch,
            )
        except Exception as error:
            raise PolicyError(
                f"policy: PyTorch cannot export it to ONNX: {type(error).__name__}: "
                f"{str(error).strip().splitlines()[0]:.300} Give a torch.nn.Module of standard "
                "layers, or write the ONNX file yourself."
            ) from error
    data = bytes(stream.getvalue())
    return _for_any_rows(data) if fixed_rows else data


def _for_any_rows(data: bytes) -> bytes:
    """A model for `_ROWS` rows, for any number; without operations on sizes, which are constant."""
    import onnx

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        start_session(data, optimized=path)
        model = onnx.load(path)
    graph = model.graph
    sizes = {node.input[1] for node in graph.node if node.op_type == "Reshape"}
    for tensor in graph.initializer:
        array = onnx.numpy_helper.to_array(tensor)
        if tensor.name in sizes:
            array = np.where(array == _ROWS, 0, array)  # as many as the input has
        elif _ROWS in array.shape:
            one = array.take([0], array.shape.index(_ROWS))
            array = one if (array == one).all() else array
        tensor.CopyFrom(onnx.numpy_helper.from_array(np.ascontiguousarray(array), tensor.name))
    del graph.value_info[:]
    for end in (*graph.input, *graph.output):
        end.type.tensor_type.shape.dim[0].dim_param = "batch"
    standard = [opset for opset in model.opset_import if not opset.domain]
    del model.opset_import[:]
    model.opset_import.extend(standard)
    return bytes(model.SerializeToString())


def _unit_policy(function: Callable[..., Any], symmetric: bool) -> Any:
    """The module from observations to unit actions, with the modules that the function uses."""
    import torch

    class UnitPolicy(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.used = torch.nn.ModuleList(_modules_of(function))

        def returned(self, x: torch.Tensor) -> Any:
            parameter = next(self.parameters(), None)
            return function(x if parameter is None else x.to(parameter.dtype))

        def unclipped(self, x: torch.Tensor) -> torch.Tensor:
            y: torch.Tensor = self.returned(x)
            return ((y + 1.0) * 0.5 if symmetric else y).float()

        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return self.unclipped(x).clamp(0.0, 1.0)

    return UnitPolicy()


def _modules_of(function: Callable[..., Any]) -> Iterator[torch.nn.Module]:
    """The modules whose parameters a module, method or function uses, where they can be seen."""
    import torch

    if isinstance(function, torch.nn.Module):
        yield function
        return
    if isinstance(function, functools.partial):
        yield from _modules_of(function.func)
        values = [*function.args, *function.keywords.values()]
    else:
        owner = getattr(function, "__self__", function)
        values = [owner, *getattr(owner, "__dict__", {}).values()]
    if inspect.isfunction(function):
        variables = inspect.getclosurevars(function)
        values += [*variables.nonlocals.values(), *variables.globals.values()]
        # Methods of what it uses: `lambda o: agent.act(o)`
        values += [part for value in values for part in getattr(value, "__dict__", {}).values()]
    yield from dict.fromkeys(value for value in values if isinstance(value, torch.nn.Module))


def _check_output(policy: Any, module: Any, interface: Interface) -> None:
    """Raise if the policy does not map tensors to actions `[B, A]`."""
    import torch

    rows = torch.full((3, interface.observation_dim), 0.5, device=device_of(module))
    with evaluating(module), torch.no_grad():
        try:
            returned = module.returned(rows)
        except Exception as error:
            raise PolicyError(
                f"policy={policy!r:.80}: fails on a PyTorch tensor {list(rows.shape)}: "
                f"{type(error).__name__}: {error}. It must map observations "
                f"[B, {interface.observation_dim}] to actions [B, {interface.action_dim}]. "
                f"{_OTHER_LIBRARIES}"
            ) from error
    actual = f"an object of type {type(returned).__name__}"
    if isinstance(returned, torch.Tensor):
        actual = f"a tensor {list(returned.shape)}"
    if actual != f"a tensor [3, {interface.action_dim}]":
        raise PolicyError(
            f"policy={policy!r:.80}: returns {actual} for 3 observations: must be one PyTorch "
            f"tensor [3, {interface.action_dim}] of deterministic actions. Give a function that "
            "returns them alone, such as `lambda o: actor(o)[0]` for a tuple or "
            f"`lambda o: actor(o).mean` for a distribution. {_OTHER_LIBRARIES}"
        )


def sb3_network(
    model: Any,
    interface: Interface | None,
    action_range: ActionRange | None = None,
    vec_normalize: Any = None,
) -> Network:
    """A model whose policy is a PyTorch module of SB3; the arguments are those of `export_onnx`."""
    network = _policy_of(model)
    spaces = {"observations": network.observation_space, "actions": network.action_space}
    shapes = {name: space.shape for name, space in spaces.items()}
    for name, shape in shapes.items():
        if shape is None or len(shape) != 1:
            raise PolicyError(
                f"model: its {name} have shape {shape}: must be vectors. Give a model trained "
                "on an SME."
            )
    if interface is not None:
        interface.check("model", **shapes)
    symmetric = _is_symmetric(network) if action_range is None else action_range == "symmetric"
    [width] = shapes["observations"]
    normaliser = _normaliser(model, vec_normalize, width)

    def act(observations: Observation) -> Any:
        inputs = observations if normaliser is None else normaliser.normalize_obs(observations)
        actions = model.predict(inputs, deterministic=True)[0]
        return (actions + 1.0) / 2.0 if symmetric else actions

    function = _deterministic(network, normaliser)
    module = _unit_policy(function, symmetric or network.squash_output)
    return Network(width, act, functools.partial(traced, module, width))


def _policy_of(model: Any) -> Any:
    """The model's policy, a PyTorch module with SB3's `_predict`."""
    from stable_baselines3.common.policies import BasePolicy

    network = getattr(model, "policy", None)
    if not isinstance(network, BasePolicy):
        raise PolicyError(
            f"model={model!r:.80}: must be a Stable-Baselines3 model or the path of its .zip."
        )
    if hasattr(network, "projection"):
        raise PolicyError(
            f"model: its policy is a {type(network).__name__}, which projects actions onto the "
            "task's limits, and a projection cannot be exported. Export a model of another "
            "algorithm, such as PPOLagrangian."
        )
    return network


def _is_symmetric(network: Any) -> bool:
    space = network.action_space
    for low in (0.0, -1.0):
        if np.all(getattr(space, "low", None) == low) and np.all(space.high == 1.0):
            return low < 0.0
    raise PolicyError(
        f"model: its action space is {space}: must be [0, 1] or [-1, 1] in every channel. "
        "Train it on one of these."
    )


def _normaliser(model: Any, vec_normalize: Any, width: int) -> Any:
    from stable_baselines3.common.vec_env import VecNormalize

    normaliser = vec_normalize
    if vec_normalize is None:
        normaliser = getattr(model, "get_vec_normalize_env", lambda: None)()
    elif isinstance(vec_normalize, str | os.PathLike):
        try:
            normaliser = pickle.loads(Path(vec_normalize).read_bytes())
        except Exception as error:
            raise PolicyError(
                f"vec_normalize={str(vec_normalize)!r}: cannot be loaded: {type(error).__name__}: "
                f"{error}. Give a file that `VecNormalize.save` wrote."
            ) from error
    if normaliser is None:
        return None
    if not isinstance(normaliser, VecNormalize):
        raise PolicyError(
            f"vec_normalize={normaliser!r:.80}: must be a VecNormalize or the path of a saved one."
        )
    if not normaliser.norm_obs:
        return None
    shape = getattr(getattr(normaliser, "obs_rms", None), "mean", np.empty(0)).shape
    if shape != (width,):
        raise PolicyError(
            f"vec_normalize: for observations of shape {shape}: must be {(width,)} for this model. "
            "Give the one from its training."
        )
    return normaliser


def _deterministic(network: Any, normaliser: Any) -> Callable[[torch.Tensor], torch.Tensor]:
    """The network's deterministic actions, of observations that are normalised as in training."""
    import torch

    def act(observations: torch.Tensor) -> torch.Tensor:
        x = observations
        if normaliser is not None:
            deviation = np.sqrt(normaliser.obs_rms.var + normaliser.epsilon)
            mean = torch.as_tensor(normaliser.obs_rms.mean, device=network.device)
            scaled = (x.double() - mean) / torch.as_tensor(deviation, device=network.device)
            x = scaled.clamp(-normaliser.clip_obs, normaliser.clip_obs).float()
        action: torch.Tensor = network._predict(x, deterministic=True)
        return action

    return act
