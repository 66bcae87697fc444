"""Autograd around kernels that have a first derivative in reverse mode, and no other."""

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch._C._dynamo.eval_frame import get_eval_frame_callback
from torch.autograd import Function, forward_ad

_REFUSAL = (
    "{} has no second derivative: its kernels compute the first one only. For a penalty on gradients, or a Hessian, "
    "take finite differences"
)


def function_of(operator: Callable[..., Any], setup_context: Callable, backward: Callable) -> type[Function]:
    """Make an operator's Function, which leaves out the Python that the dispatcher runs in between."""

    def forward(*inputs: Any) -> Any:
        with torch._C._AutoDispatchBelowAutograd():
            return operator(*inputs)

    parts = {"forward": forward, "setup_context": setup_context, "backward": backward}
    return type("Direct", (Function,), {name: staticmethod(part) for name, part in parts.items()})


def direct_apply(function: type[Function], transformed: type[Function] | None = None) -> Callable[..., Any]:
    """Return a Function's `apply` without the inspection of its signature that torch does in every call.

    transformed: takes its place in transforms of torch.func, which need a Function with `setup_context`.
    """
    direct = super(Function, function).apply
    in_transforms = (transformed or function).apply

    def apply(*inputs: Any) -> Any:
        return (in_transforms if torch._C._are_functorch_transforms_active() else direct)(*inputs)

    return apply


def is_compiled() -> bool:
    """Tell whether the call is part of a function of torch.compile, which takes operators and fails in Functions.

    A break of the graph ends `is_compiling` for the rest of a function, but torch.compile still sees what the rest
    calls.
    """
    return torch.compiler.is_compiling() or get_eval_frame_callback() is not None


def needs_function(*inputs: Tensor | None) -> bool:
    """Tell whether a call has to pass autograd's Function: for gradients, or to raise where inputs have tangents.

    An operator alone would drop the tangents of forward mode.
    """
    if forward_ad._current_level >= 0:
        return True
    return torch.is_grad_enabled() and any([values is not None and values.requires_grad for values in inputs])


class _Final(Function):
    """Makes the first `count` of the tensors results that depend on all of the tensors and have no derivative."""

    generate_vmap_rule = True

    @staticmethod
    def forward(name: str, count: int, *tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(values.view_as(values) for values in tensors[:count])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.name = inputs[0]

    @staticmethod
    def backward(ctx: Any, *_: Tensor) -> tuple:
        raise RuntimeError(_REFUSAL.format(ctx.name))


class _Unpacked:
    """A context whose saved tensors are unpacked once, as activation checkpointing lets them be."""

    def __init__(self, ctx: Any) -> None:
        self._ctx, self.saved_tensors = ctx, ctx.saved_tensors

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ctx, name)


def first_order(name: str) -> Callable[[Callable[..., tuple]], Callable[..., tuple]]:
    """Make the decorator of a backward whose results raise RuntimeError, with the name, when they are differentiated.

    torch's once_differentiable raises only where the incoming gradients need a derivative, and only on the way to them.
    It would let a penalty on the gradient of a sum add nothing, and make a Hessian 0.
    """

    def decorate(backward: Callable[..., tuple]) -> Callable[..., tuple]:
        """Return a backward whose results refuse to be differentiated."""

        @functools.wraps(backward)
        def wrapper(ctx: Any, *gradients: Tensor | None) -> tuple:
            if not torch.is_grad_enabled():
                return backward(ctx, *gradients)  # there will be no second derivative
            ctx = _Unpacked(ctx)
            with torch.no_grad():
                results = backward(ctx, *gradients)
            found = [values for values in results if values is not None]
            sources = [values for values in (*ctx.saved_tensors, *gradients) if values is not None]
            final = iter(_Final.apply(name, len(found), *found, *sources))
            return tuple(None if values is None else next(final) for values in results)

        return wrapper

    return decorate
