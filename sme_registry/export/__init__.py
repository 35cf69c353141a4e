"""`export_onnx`: the deterministic policy of a network as an ONNX file.

    input `observations` [B, O] float32  →  output `actions` [B, A] float32 in [0, 1]

The graph contains every step from an observation to an action of the unit range, clipping
included. Its actions are compared with the policy's, and a file that differs is never written.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from sme_registry.errors import OptionError, PolicyError
from sme_registry.evaluation import Perceptron
from sme_registry.evaluation.models import (
    ACTION_RANGE,
    Interface,
    load_sb3,
    start_session,
    torch_policy,
)
from sme_registry.evaluation.networks import OfflinePolicy
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

__all__ = ["FEED_FORWARD", "export_onnx", "onnx_bytes"]

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
            'The tutorial "Your own agent" lists the operators that pass.',
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
    try:  # boards accept no tensors of computed sizes
        data = _finished(network.to_onnx(fixed_rows=True))
        _check_difference(data, network)
    except PolicyError:
        data = _finished(network.to_onnx(fixed_rows=False))
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


def _finished(data: bytes) -> bytes:
    """The model with its action range as metadata."""
    import onnx

    model = onnx.load_model_from_string(data)
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
