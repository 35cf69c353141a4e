"""Hyperparameters of BC and IQL, with the source of each default. Does not import PyTorch.

| | BC | IQL | source |
|---|---|---|---|
| hidden layers, ReLU | 256, 256 | 256, 256 in each network | IQL's paper; d3rlpy |
| Adam's learning rate | 1e-3 | 3e-4 for actor, critics and value | d3rlpy's BC; IQL's paper |
| discount γ | – | 0.99 | IQL's paper |
| expectile τ | – | 0.7 | METHOD, section 4; IQL's paper on locomotion |
| inverse temperature β | – | 3.0, weights at most 100 | IQL's paper on locomotion |
| soft update of the target critics | – | 0.005 each step | IQL's paper |

IQL's paper: Kostrikov, Nair, Levine, *Offline Reinforcement Learning with Implicit Q-Learning*,
2021. It also decays the actor's learning rate by a cosine; neither d3rlpy nor this package does.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from sme_registry.errors import OptionError
from sme_registry.spec import Integer, Real, StrictModel

_Width = Annotated[Integer, Field(ge=1, le=4096)]
_Widths = Annotated[tuple[_Width, ...], Field(strict=False, min_length=1, max_length=8)]
_Rate = Annotated[Real, Field(gt=0, le=1)]


class BCHyperparameters(StrictModel):
    """Hyperparameters of behaviour cloning.

    Attributes:
      hidden: widths of the policy's hidden layers.
      learning_rate: of Adam.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 1e-3


class IQLHyperparameters(StrictModel):
    """Hyperparameters of implicit Q-learning.

    Attributes:
      hidden: widths of the hidden layers of policy, critics and value function.
      learning_rate: of Adam, for all networks.
      discount: γ.
      expectile: τ of the value function; ½ gives the mean, values near 1 the maximum.
      inverse_temperature: β; 0 gives behaviour cloning.
      max_weight: upper limit of exp(β advantage).
      target_rate: ρ of the soft update of the target critics in each step.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 3e-4
    discount: Annotated[Real, Field(ge=0, lt=1)] = 0.99
    expectile: Annotated[Real, Field(gt=0, lt=1)] = 0.7
    inverse_temperature: Annotated[Real, Field(ge=0, le=1000)] = 3.0
    max_weight: Annotated[Real, Field(gt=0, le=1e6)] = 100.0
    target_rate: _Rate = 0.005


Hyperparameters = BCHyperparameters | IQLHyperparameters

# Names with their descriptions in `sme offline train --help`.
ALGORITHMS: dict[str, str] = {
    "bc": "behaviour cloning: regression to the actions of the data set",
    "iql": "implicit Q-learning: cloning weighted by the advantage of each action",
}
_FIELDS: dict[str, type[Hyperparameters]] = {"bc": BCHyperparameters, "iql": IQLHyperparameters}


def resolve_hyperparameters(algorithm: str, changes: Mapping[str, Any] | None) -> Hyperparameters:
    """The hyperparameters of an algorithm of `ALGORITHMS`: its defaults, with changes."""
    if changes is not None and not isinstance(changes, Mapping):
        raise OptionError(f"hyperparameters={changes!r:.60}: must be a mapping of names to values.")
    return _FIELDS[algorithm].from_dict(dict(changes or {}), "hyperparameters")
