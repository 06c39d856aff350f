"""The transfer of the theory as a function of strength and damping that autograd can differentiate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.theory.transfer import theory_transfer

_STEP = 1e-3  # of the central differences, relative to the strength; of the damping, absolute
_WEAKEST = 1e-6


def transfer_at(
    strength: Tensor,
    n_particles: int,
    n_bands: int,
    times: Any,
    damping: Tensor | float = 0.0,
    tones: Sequence[int] | None = None,
    kind: str = "normal",
    lower: float = 0.05,
) -> Tensor:
    """``theory_transfer(...).mean``, [source, time, receiver], with its derivatives in strength and contact damping.

    The derivatives are central differences, each of two more transfers: the medium is solved to 1e-11, so that they hold to
    1e-5. The first derivative alone.

    Args:
        strength: xi of the masses, a scalar; one that requires its gradient gets it by ``backward``.
        n_particles, n_bands, times, tones: see :func:`theory_transfer`.
        damping: of the contacts, a scalar, likewise.
        kind, lower: law of the masses, see :class:`Disorder`.

    Raises:
        FieldError: for strength or damping that are no scalars, and for what the theory does not hold for.

    Example:
        >>> strength = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)
        >>> share = tc.theory.transfer_at(strength, 64, 8, [5.0])
        >>> share[5, 0, 5].backward()  # how fast a band loses its energy grows with the disorder
        >>> strength.grad.item() < 0
        True
    """
    checks.instance("strength", strength, Tensor)
    damping = torch.as_tensor(damping, dtype=torch.float64)
    for name, value in (("strength", strength), ("damping", damping)):
        if value.ndim:
            raise checks.fail(name, "be a scalar", f"shape {tuple(value.shape)}")

    def mean(xi: float, loss: float) -> Tensor:
        disorder = Disorder(kind=kind, strength=xi, lower=lower)
        return theory_transfer(disorder, n_particles, n_bands, times, tones, damping=loss).mean

    result: Tensor = _Differences.apply(strength, damping, mean)
    return result


class _Differences(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, strength: Tensor, damping: Tensor, mean: Callable[[float, float], Tensor]) -> Tensor:
        ctx.save_for_backward(strength, damping)
        ctx.mean = mean
        return mean(float(strength), float(damping))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        strength, damping = ctx.saved_tensors
        xi, loss = float(strength), float(damping)
        found: list[Tensor | None] = [None, None]
        if ctx.needs_input_grad[0]:
            low, high = max(xi * (1 - _STEP), 0.0), max(xi * (1 + _STEP), _WEAKEST)
            change = (ctx.mean(high, loss) - ctx.mean(low, loss)) / (high - low)
            found[0] = (gradients[0] * change).sum().to(strength)
        if ctx.needs_input_grad[1]:
            low, high = max(loss - _STEP, 0.0), loss + _STEP
            change = (ctx.mean(xi, high) - ctx.mean(xi, low)) / (high - low)
            found[1] = (gradients[0] * change).sum().to(damping)
        return found[0], found[1], None
