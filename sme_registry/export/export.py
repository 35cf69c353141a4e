"""`export_onnx`: the deterministic policy of a network as an ONNX file.

    input `observations` [B, O] float32  →  output `actions` [B, A] float32 in [0, 1]

The graph contains every step from an observation to an action of the unit range, clipping
included. Its actions are compared with the policy's, and a file that differs is never written.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import OfflinePolicy, Perceptron, load_sb3
from sme_registry.evaluation.models import ACTION_RANGE, Interface, start_session, torch_policy
from sme_registry.evaluation.policies import interface_of
from sme_registry.export.networks import (
    INPUT,
    Network,
    array_network,
    sb3_network,
    torch_network,
)
from sme_registry.io import check_writable, choice, require_packages, write_atomically
from sme_registry.spec import SMESpec
from sme_registry.spec.sme_spec import ACTION_RANGES, ActionRange, SpecLike
from sme_registry.task import load

_NAMES = """
    Abs Acos Acosh Add And ArgMax ArgMin Asin Asinh Atan Atanh BatchNormalization Cast Ceil Celu
    Clip Concat Constant Cos Cosh Div Elu Equal Erf Exp Flatten Floor Gather GatherElements Gelu
    Gemm Greater GreaterOrEqual HardSigmoid HardSwish Identity LayerNormalization LeakyRelu Less
    LessOrEqual Log LogSoftmax MatMul Max Mean Min Mish Mod Mul Neg Not Or PRelu Pow
    RMSNormalization Reciprocal ReduceL1 ReduceL2 ReduceLogSumExp ReduceMax ReduceMean ReduceMin
    ReduceProd ReduceSum ReduceSumSquare Relu Reshape Round Selu Sigmoid Sign Sin Sinh Slice Softmax
    Softplus Softsign Split Sqrt Squeeze Sub Sum Tan Tanh ThresholdedRelu Transpose Unsqueeze Where
    Xor
"""
FEED_FORWARD = frozenset(_NAMES.split())
"""The operators of feed-forward networks, the only ones that boards accept.

They map rows to rows with weights. Excluded: randomness, loops and branches, sequences, text, and
arrays whose size is a number in the model, as of ConstantOfShape or Tile.
"""

TOLERANCE = 1e-6
# Float32 networks are exact only up to rounding: trained TD3s differed from float64 by up to
# 1.2e-6, and from themselves row by row by 7e-7. So 99 of 100 actions must be within the tolerance,
# and the others within this.
_LARGEST_DIFFERENCE = 1e-5
_CHECKED_ROWS = 1024


def export_onnx(
    policy: Any,
    spec: SpecLike,
    path: str | os.PathLike[str],
    *,
    action_range: ActionRange | None = None,
    vec_normalize: Any = None,
) -> Path:
    """Write a policy as an ONNX file, and check the file against the policy.

    The file has opset 17, weights inside, any batch size, and actions in [0, 1]. A `UserWarning`
    names the operators that boards do not accept, if it has any.

    Args:
      policy: a `torch.nn.Module`, or a function of PyTorch tensors such as
        `lambda o: actor(o).mean`; a `Perceptron` of arrays; a Stable-Baselines3 model, or the path
        of its .zip (loading it can run code of its author); an offline policy, or the path of its
        .npz. For a team, the policy that all agents share.
      action_range: of the policy's actions, "unit" for [0, 1] or "symmetric" for [−1, 1]; None
        takes an SB3 model's own action space, and "unit" for any other policy.
      vec_normalize: of an SB3 model, the `VecNormalize` of its training, or the path of its saved
        file (which can run code too). None takes that of the model's environment, if any.

    Examples:
      >>> from sme_registry.evaluation import Perceptron
      >>> policy = Perceptron([(np.zeros((10, 4)), np.full(4, 0.5), "identity")])
      >>> path = sme_registry.export_onnx(policy, "Default", "half.onnx", action_range="unit")
      >>> sme_registry.evaluate("half.onnx", "Default", "quick-v1").policy
      'half'
    """
    if not os.fspath(path).endswith(".onnx"):
        raise OptionError(f"path={os.fspath(path)!r}: must end in .onnx.")
    check_writable(path)
    data = onnx_bytes(policy, spec, action_range=action_range, vec_normalize=vec_normalize)
    written = write_atomically(path, data)
    refused = _refused_by_boards(data)
    if refused:
        warnings.warn(
            f"{written}: has the operators {', '.join(refused)}, which boards do not accept; "
            "evaluations do. To submit it, export the feed-forward actor alone, and write it with "
            "`@`, slices, `split(n, -1)`, `cat` and `view(-1, n)`. "
            "docs/tutorials/own_agents.md says which operators pass.",
            stacklevel=2,
        )
    return written


def onnx_bytes(
    policy: Any,
    spec: SpecLike | None,
    *,
    action_range: ActionRange | None = None,
    vec_normalize: Any = None,
) -> bytes:
    """The content of the file that `export_onnx` writes.

    `spec` may be None for an SB3 model and for a policy of arrays, which know their widths.

    Examples:
      >>> from sme_registry.evaluation import Perceptron
      >>> from sme_registry.export import onnx_bytes
      >>> policy = Perceptron([(np.zeros((10, 4)), np.full(4, 0.5), "identity")])
      >>> len(onnx_bytes(policy, None, action_range="unit")) > 100
      True
    """
    libraries = {"onnx": "onnx", "onnxruntime": "ONNX Runtime"}
    require_packages("exporting a policy", libraries, "onnx")
    if action_range is not None:
        choice("action_range", action_range, ACTION_RANGES)
    interface = None if spec is None else interface_of(load(spec, SMESpec))
    network = _network(policy, interface, action_range, vec_normalize)
    written = network.to_onnx()
    try:  # boards accept no tensors of computed sizes
        data = _finished(written, network.observation_dim, folded=True)
        _check_difference(data, network)
    except PolicyError:
        data = _finished(written, network.observation_dim, folded=False)
        _check_difference(data, network)
    return data


def _network(
    policy: Any, interface: Interface | None, action_range: ActionRange | None, vec_normalize: Any
) -> Network:
    """The policy as a network that writes itself."""
    policy = _loaded(policy)
    if hasattr(policy, "predict"):
        if torch_policy(policy) is None:
            raise PolicyError(
                f"policy={policy!r:.80}: predicts by other means than a PyTorch policy of "
                "Stable-Baselines3, such as JAX or a recurrent state. Give its network as a "
                "torch.nn.Module or its parameters as a `Perceptron`."
            )
        return sb3_network(policy, interface, action_range, vec_normalize)
    if vec_normalize is not None:
        raise PolicyError("vec_normalize: is for models of Stable-Baselines3. Leave it out.")
    symmetric = action_range == "symmetric"
    if isinstance(policy, Perceptron):
        if interface is not None:
            shapes = {
                "observations": (policy.observation_dim,),
                "actions": (policy.action_dim,),
            }
            interface.check("policy", **shapes)
        return array_network(policy, symmetric)
    if interface is None or not callable(policy):
        raise PolicyError(
            f"policy={policy!r:.80}: must be a torch.nn.Module, a function of PyTorch tensors, a "
            "`Perceptron`, a Stable-Baselines3 model, or the path of a .zip or .npz."
        )
    return torch_network(policy, interface, symmetric)


def _loaded(policy: Any) -> Any:
    if not isinstance(policy, str | os.PathLike):
        return policy
    path = Path(policy)
    if path.suffix == ".zip":
        return load_sb3(path)
    if path.suffix == ".npz":
        return OfflinePolicy.load(path)
    raise PolicyError(
        f"policy={str(policy)!r}: must be the path of a .zip or an .npz, or a network."
    )


def _finished(data: bytes, observation_dim: int, *, folded: bool) -> bytes:
    """The model with its action range as metadata, and without unused nodes."""
    import onnx

    model = onnx.load_model_from_string(data)
    if folded:
        for node in model.graph.node:
            if node.op_type == "Expand":
                node.op_type = "Identity"
                del node.input[1:]
        _fold_shapes(model, observation_dim)
    used, kept = {output.name for output in model.graph.output}, []
    for node in reversed(model.graph.node):
        if used.intersection(node.output):
            used.update(_read_by(node))
            kept.append(node)
    del model.graph.node[:]
    model.graph.node.extend(reversed(kept))
    onnx.helper.set_model_props(model, {ACTION_RANGE: "unit"})
    return bytes(model.SerializeToString())


def _refused_by_boards(data: bytes) -> list[str]:
    import onnx

    model = onnx.load_model_from_string(data)
    return sorted({node.op_type for node in model.graph.node} - FEED_FORWARD)


def _check_difference(data: bytes, network: Network) -> None:
    """Raise if the file's actions differ from the policy's, inside or outside the cube."""
    random = np.random.default_rng(0)
    inside = random.random((_CHECKED_ROWS, network.observation_dim), dtype=np.float32)
    observations = np.concatenate([inside, 2.0 * inside[::-1] - np.float32(0.5)])
    session = start_session(data)
    try:
        actions = session.run(None, {INPUT: observations})[0]
    except Exception as error:
        raise PolicyError(
            f"policy: its ONNX file fails on {len(observations)} observations: {error}. The "
            "network must treat the rows of a batch alike, whatever their number. For sizes write "
            "`x.shape[0]` or -1 instead of `len(x)`."
        ) from error
    expected = np.clip(network.act(observations), 0.0, 1.0)
    same_shape = actions.shape == expected.shape
    differences = np.abs(actions - expected) if same_shape else np.full(1, np.inf)
    difference = float(differences.max())
    with np.errstate(invalid="ignore"):  # of infinite differences
        typical = float(np.quantile(differences, 0.99))
    if not (typical <= TOLERANCE and difference <= _LARGEST_DIFFERENCE):
        raise PolicyError(
            f"policy: its ONNX file differs from its own actions by {difference:.1e}: must be at "
            f"most {TOLERANCE:g}. Check that it is deterministic and depends only on the "
            "observation, or write the ONNX file yourself."
        )


def _fold_shapes(model: Any, observation_dim: int) -> None:
    """Replace what is computed from shapes alone by the numbers that it computes, in place.

    PyTorch computes sizes from `Shape`, although only the batch size varies. What depends on no
    entry of the observations is computed for two batch sizes; what is equal, or has equal rows,
    becomes a constant.
    """
    import onnx

    nodes = list(model.graph.node)
    computed = set(_computed_from_shapes(model))
    folded = {
        name
        for node in nodes
        if not computed.issuperset(node.output)
        for name in _read_by(node)
        if name in computed
    }
    folded -= {name for node in nodes if node.op_type == "Constant" for name in node.output}
    if not folded:
        return
    reshapes = [node for node in nodes if node.op_type == "Reshape" and node.input[1] in folded]
    few, many = _values(model, observation_dim, folded | {node.output[0] for node in reshapes})
    constants = {name: _constant(few[name], many[name]) for name in folded}
    for node in reshapes:
        # Sizes of its own: another reader of these may need the batch size itself.
        output = node.output[0]
        sizes = _sizes(few[output].shape, many[output].shape)
        if constants[node.input[1]] is None and sizes is not None:
            node.input[1] = f"{output}.sizes"
            constants[node.input[1]] = sizes
    constants = {name: value for name, value in constants.items() if value is not None}
    del model.graph.node[:]
    for name, value in sorted(constants.items()):
        tensor = onnx.numpy_helper.from_array(np.ascontiguousarray(value), name)
        model.graph.node.append(onnx.helper.make_node("Constant", [], [name], value=tensor))
    model.graph.node.extend(node for node in nodes if constants.keys().isdisjoint(node.output))


def _read_by(node: Any) -> Iterator[str]:
    """The values that a node reads, those in its branches and loops included."""
    yield from node.input
    for graph in _subgraphs(node):
        yield from (output.name for output in graph.output)
        for inner in graph.node:
            yield from _read_by(inner)


def _subgraphs(node: Any) -> list[Any]:
    attributes = node.attribute
    return [part.g for part in attributes if part.HasField("g")] + [
        graph for part in attributes for graph in part.graphs
    ]


def _computed_from_shapes(model: Any) -> Iterator[str]:
    """The outputs of nodes that depend on no entry of the observations, only on their shape."""
    dependent = {INPUT}
    for node in model.graph.node:
        outputs = [name for name in node.output if name]
        read = () if node.op_type in ("Shape", "Size") else _read_by(node)
        # One output each: the constant that replaces it is a node of its own.
        if len(outputs) != 1 or _subgraphs(node) or dependent.intersection(read):
            dependent.update(outputs)
        else:
            yield outputs[0]


def _values(model: Any, observation_dim: int, names: Iterable[str]) -> list[dict[str, Any]]:
    """The values of these names for two batch sizes."""
    import onnx

    names = sorted(names)
    probe = onnx.ModelProto()
    probe.CopyFrom(model)
    del probe.graph.output[:]
    probe.graph.output.extend(onnx.ValueInfoProto(name=name) for name in names)
    session = start_session(probe.SerializeToString())
    random = np.random.default_rng(0)
    batches = [random.random((rows, observation_dim), dtype=np.float32) for rows in (2, 3)]
    return [dict(zip(names, session.run(names, {INPUT: x}), strict=True)) for x in batches]


def _constant(few: Any, many: Any) -> Any:
    """The value for any batch size, one row where all are equal; None if there is no such value."""
    if few.shape == many.shape:
        return few if np.array_equal(few, many) else None
    axis = _batch_axis(few.shape, many.shape)
    if axis is None:
        return None
    one = few.take([0], axis)
    return one if (few == one).all() and (many == one).all() else None


def _sizes(few: tuple[int, ...], many: tuple[int, ...]) -> Any:
    """The sizes to reshape to, −1 for that of the batch."""
    axis = _batch_axis(few, many)
    if few != many and axis is None:
        return None
    return np.array([-1 if i == axis else size for i, size in enumerate(few)], dtype=np.int64)


def _batch_axis(few: tuple[int, ...], many: tuple[int, ...]) -> int | None:
    """The one axis whose length differs."""
    if len(few) != len(many):
        return None
    axes = [axis for axis, sizes in enumerate(zip(few, many, strict=True)) if len({*sizes}) > 1]
    return axes[0] if len(axes) == 1 else None
