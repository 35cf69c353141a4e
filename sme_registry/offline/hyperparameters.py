"""What can be set of BC and IQL, and where each default is from. No PyTorch here.

| | BC | IQL | from |
|---|---|---|---|
| hidden layers, ReLU | 256, 256 | 256, 256 in each network | IQL's paper; d3rlpy |
| Adam's learning rate | 1e-3 | 3e-4 for actor, critics and value | d3rlpy's BC; IQL's paper |
| discount γ | – | 0.99 | IQL's paper |
| expectile τ | – | 0.7 | METHOD, section 4; IQL's paper on locomotion |
| inverse temperature β | – | 3.0, weights at most 100 | IQL's paper on locomotion |
| soft update of the target critics | – | 0.005 each step | IQL's paper |

IQL's paper: Kostrikov, Nair, Levine, *Offline Reinforcement Learning with Implicit Q-Learning*,
2021. It also lets the actor's learning rate decay by a cosine; d3rlpy does not, nor do we.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from sme_registry.errors import OptionError, UnknownNameError, did_you_mean
from sme_registry.spec.document import Integer, Real, StrictModel

_Width = Annotated[Integer, Field(ge=1, le=4096)]
_Widths = Annotated[tuple[_Width, ...], Field(strict=False, min_length=1, max_length=8)]
_Rate = Annotated[Real, Field(gt=0, le=1)]


class BCHyperparameters(StrictModel):
    """Of behaviour cloning.

    Attributes:
      hidden: widths of the policy's hidden layers.
      learning_rate: Adam's.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 1e-3


class IQLHyperparameters(StrictModel):
    """Of implicit Q-learning.

    Attributes:
      hidden: widths of the hidden layers of policy, critics and value function.
      learning_rate: Adam's, of all of them.
      discount: γ.
      expectile: τ of the value function; ½ is the mean, towards 1 the maximum.
      inverse_temperature: β; 0 is behaviour cloning.
      max_weight: what exp(β advantage) is cut at.
      target_rate: the share of the critics that moves into their targets in each step.
    """

    hidden: _Widths = (256, 256)
    learning_rate: _Rate = 3e-4
    discount: Annotated[Real, Field(ge=0, lt=1)] = 0.99
    expectile: Annotated[Real, Field(gt=0, lt=1)] = 0.7
    inverse_temperature: Annotated[Real, Field(ge=0, le=1000)] = 3.0
    max_weight: Annotated[Real, Field(gt=0, le=1e6)] = 100.0
    target_rate: _Rate = 0.005


Hyperparameters = BCHyperparameters | IQLHyperparameters

# Each with what `sme offline train --help` says of it.
ALGORITHMS: dict[str, str] = {
    "bc": "behaviour cloning: the policy of least squared error to the actions of the set",
    "iql": "implicit Q-learning: cloning that weighs each action by its advantage",
}
_FIELDS: dict[str, type[BCHyperparameters] | type[IQLHyperparameters]] = {
    "bc": BCHyperparameters,
    "iql": IQLHyperparameters,
}


def known_algorithm(name: str) -> str:
    """The algorithm's name as it is written, whatever the case it was given in.

    Raises:
      UnknownNameError: no such algorithm; says which there are and what is near.
    """
    found = str(name).casefold()
    if found not in ALGORITHMS:
        raise UnknownNameError(
            f"algorithm={name!r}: must be one of {', '.join(ALGORITHMS)}."
            f"{did_you_mean(found, ALGORITHMS)}"
        )
    return found


def hyperparameters_of(algorithm: str, changes: Mapping[str, Any] | None) -> Hyperparameters:
    """An algorithm's hyperparameters: its defaults, with some changed.

    Raises:
      UnknownNameError: no such algorithm.
      OptionError: `changes` is no mapping.
      SpecError: a field is unknown, or its value out of range.
    """
    kind = _FIELDS[known_algorithm(algorithm)]
    if changes is not None and not isinstance(changes, Mapping):
        raise OptionError(f"hyperparameters={changes!r:.60}: must be a mapping of names to values.")
    return kind.from_dict(dict(changes or {}), "hyperparameters")
