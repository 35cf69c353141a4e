"""Ranges of hyperparameters, as types: `run.settings_of` checks them.

Strict, as Stable-Baselines3 is: a text or a truth value is no number, a number no truth value.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, StrictBool, ValidationError, ValidatorFunctionWrapHandler, WrapValidator
from pydantic_core import PydanticCustomError


def _widths(value: Any, check: ValidatorFunctionWrapHandler) -> Any:
    try:
        return check(value)
    except ValidationError:
        raise PydanticCustomError(
            "widths", "must be a list of widths of at least 1, such as [256, 256]"
        ) from None


Flag = StrictBool
Count = Annotated[int, Field(ge=1, strict=True)]
CountFromZero = Annotated[int, Field(ge=0, strict=True)]
Updates = Annotated[int, Field(ge=-1, strict=True)]
"""In one go; −1 for as many as steps before them."""
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False, strict=True)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False, strict=True)]
Share = Annotated[float, Field(ge=0.0, le=1.0, strict=True)]
Weight = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1), WrapValidator(_widths)]
"""Of hidden layers."""
