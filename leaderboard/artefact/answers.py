"""Answers in challenge states: an .npy file of float32, whose reading runs no code."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from leaderboard.errors import Rejection
from sme_registry.errors import ActionError, WireError
from sme_registry.seasons.wire import unpack_table
from sme_registry.spec import EvaluationProtocol, Setting

Float32 = npt.NDArray[np.float32]


def rows_of(protocol: EvaluationProtocol) -> int:
    """The number of challenge states of an instance: of each region as many."""
    return protocol.states_per_region * len(protocol.edges)


def read_answers(data: bytes, setting: Setting, protocol: EvaluationProtocol) -> Float32:
    """The answers in the bytes of a file.

    Args:
      data: the file.
      setting: of the hidden task.
      protocol: of its season.

    Returns:
      `[regions · n, A]` finite actions, which are not clipped yet.

    Raises:
      Rejection: `answer_shape` or `answer_not_finite`.
    """
    try:
        return unpack_table(data, setting.action_dim, rows_of(protocol))
    except WireError as error:
        raise Rejection("answer_shape", str(error)) from None
    except ActionError as error:
        raise Rejection("answer_not_finite", str(error)) from None
