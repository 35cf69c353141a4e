"""PyTorch modules as policies, and the actions that functions return as tensors.

PyTorch is never imported here: who has a module or a tensor has imported it.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError


def is_module(policy: Any) -> bool:
    """Whether a policy is a `torch.nn.Module`."""
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


def hidden_layers(
    act: Callable[[Observation], Any], module: Any
) -> Callable[[Observation], list[Any] | None]:
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
    if _torch() is None or not isinstance(error, AttributeError | TypeError):
        return ""
    if "ndarray" not in str(error):
        return ""
    return " Observations are NumPy arrays: `torch.as_tensor(observations)` is the tensor of them."


def device_of(module: Any) -> Any:
    """The device of a module's parameters."""
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


def _torch() -> Any:
    """PyTorch, if it is imported."""
    return sys.modules.get("torch")
