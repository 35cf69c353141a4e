"""Policies as ONNX files, which `sme evaluate` runs and leaderboards accept."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sme_registry.export.export import export_onnx, onnx_bytes

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


def __getattr__(name: str) -> Any:
    if name in __all__:  # a leaderboard needs only the operators
        from sme_registry.export import export

        return getattr(export, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
