"""PyTorch modules and functions as ONNX.

By PyTorch's tracing exporter: its successor needs another package and is ten times slower.
"""

from __future__ import annotations

import functools
import inspect
import io
import warnings
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from sme_registry.envs.types import Observation
from sme_registry.errors import PolicyError
from sme_registry.evaluation.models import Interface, device_of, evaluating
from sme_registry.export.network import INPUT, OPSET, OUTPUT, Network
from sme_registry.io import require_packages

if TYPE_CHECKING:
    import torch

_OTHER_LIBRARIES = "Give networks of other libraries, and linear maps, as a `Perceptron` of arrays."


def network(policy: Any, interface: Interface, symmetric: bool) -> Network:
    """A module or function from observations to actions in [−1, 1] if `symmetric`, else [0, 1]."""
    require_packages("exporting a function", {"torch": "PyTorch"}, "train")
    module = _unit_policy(policy, symmetric)
    _refuse_output(policy, module, interface)

    def act(observations: Observation) -> Any:
        import torch

        with evaluating(module), torch.no_grad():
            actions = module.unclipped(torch.as_tensor(observations, device=device_of(module)))
        return actions.cpu().numpy()

    width = interface.observation_dim
    return Network(width, act, lambda: traced(module, width))


def traced(module: Any, width: int) -> bytes:
    """A module from observations `[B, width]` to actions as ONNX, in evaluation mode."""
    import torch

    stream: Any = io.BytesIO()
    rows = torch.zeros((2, width), device=device_of(module))
    # Warnings of tracing are for PyTorch's developers: the file is compared with the module.
    with evaluating(module), warnings.catch_warnings(action="ignore"), torch.no_grad():
        try:
            torch.onnx.export(
                module,
                (rows,),
                stream,
                dynamo=False,
                opset_version=OPSET,
                input_names=[INPUT],
                output_names=[OUTPUT],
                dynamic_axes={INPUT: {0: "batch"}, OUTPUT: {0: "batch"}},
            )
        except Exception as error:
            raise PolicyError(
                f"policy: PyTorch cannot export it to ONNX: {type(error).__name__}: "
                f"{str(error).strip().splitlines()[0]:.300} Give a torch.nn.Module of standard "
                "layers, or write the ONNX file yourself."
            ) from error
    return bytes(stream.getvalue())


def _unit_policy(policy: Any, symmetric: bool) -> Any:
    """The module from observations to unit actions, with the modules that the policy uses."""
    import torch

    function = getattr(policy, "_orig_mod", policy)  # what `torch.compile` wraps

    class UnitPolicy(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.used = torch.nn.ModuleList(_modules_of(function))

        def unclipped(self, x: torch.Tensor) -> torch.Tensor:
            parameter = next(self.parameters(), None)
            y: torch.Tensor = function(x if parameter is None else x.to(parameter.dtype))
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
        if isinstance(owner, torch.nn.Module):
            yield owner
        values = list(getattr(owner, "__dict__", {}).values())
    if inspect.isfunction(function):
        seen = inspect.getclosurevars(function)
        values += [*seen.nonlocals.values(), *seen.globals.values()]
        # Methods of what it uses: `lambda o: agent.act(o)`
        values += [each for value in values for each in getattr(value, "__dict__", {}).values()]
    yield from dict.fromkeys(value for value in values if isinstance(value, torch.nn.Module))


def _refuse_output(policy: Any, module: Any, interface: Interface) -> None:
    """Raise if the policy does not map tensors to actions `[B, A]`."""
    import torch

    rows = torch.full((3, interface.observation_dim), 0.5, device=device_of(module))
    function = getattr(policy, "_orig_mod", policy)
    parameter = next(module.parameters(), None)
    with evaluating(module), torch.no_grad():
        try:
            returned = function(rows if parameter is None else rows.to(parameter.dtype))
        except Exception as error:
            raise PolicyError(
                f"policy={policy!r:.80}: fails on a PyTorch tensor {list(rows.shape)}: "
                f"{type(error).__name__}: {error}. It must map observations "
                f"[B, {interface.observation_dim}] to actions [B, {interface.action_dim}]. "
                f"{_OTHER_LIBRARIES}"
            ) from error
    shape = (3, interface.action_dim)
    if isinstance(returned, torch.Tensor) and tuple(returned.shape) == shape:
        return
    if isinstance(returned, torch.Tensor):
        actual = f"a tensor {list(returned.shape)}"
    else:
        actual = f"an object of type {type(returned).__name__}"
    raise PolicyError(
        f"policy={policy!r:.80}: returns {actual} for 3 observations: must be one PyTorch tensor "
        f"[3, {interface.action_dim}] of deterministic actions. Give a function that returns them "
        "alone, such as `lambda o: actor(o)[0]` for a tuple or `lambda o: actor(o).mean` for a "
        f"distribution. {_OTHER_LIBRARIES}"
    )
