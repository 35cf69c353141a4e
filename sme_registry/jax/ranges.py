"""Ranges of hyperparameters, as types: `run.settings_of` checks them."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

Count = Annotated[int, Field(ge=1, strict=True)]
CountFromZero = Annotated[int, Field(ge=0, strict=True)]
Updates = Annotated[int, Field(ge=-1, strict=True)]
"""In one go; −1 for as many as steps before them."""
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(allow_inf_nan=False)]
Widths = Annotated[tuple[Count, ...], Field(min_length=1)]
"""Of hidden layers."""
