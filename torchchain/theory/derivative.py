"""The transfer of the theory as a function of strength and damping that autograd can differentiate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.theory.law import law_of
from torchchain.theory.transfer import described, transfer_of_law

_WEAKEST = 1e-6  # xi below which the slope in xi is 0


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

    Derivatives are exact: forward mode goes through the whole solver, and through the coherent potential by the implicit function
    theorem (one Newton step from the solution). Each takes the time of some three transfers. The first derivative alone.

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
            raise checks.fail(name, "be a scalar", value)

    disorder = Disorder(kind=kind, strength=float(strength.detach()), lower=lower)
    times = checks.times("times", times).to(torch.float64)
    law, waves = described(
        disorder, n_particles, n_bands, tones, "periodic", None, "linear", float(damping.detach()), float(times[-1])
    )

    given = (strength.detach().double(), damping.detach())

    def mean(xi: Tensor, loss: Tensor) -> Tensor:
        at = law if float(xi) < _WEAKEST else law_of(disorder, strength=xi)  # even in xi: without a slope at 0
        return transfer_of_law(at, replace(waves, damping=loss if damping.requires_grad else float(loss)), times).mean

    found: Tensor | None = None
    slopes: list[Tensor | None] = []
    for i, scalar in enumerate((strength, damping)):
        if not scalar.requires_grad:
            slopes.append(None)
            continue
        with forward_ad.dual_level():
            moving = forward_ad.make_dual(given[i], torch.ones_like(given[i]))
            found, slope = forward_ad.unpack_dual(mean(*(moving if j == i else given[j] for j in range(2))))
            slopes.append(torch.zeros_like(found) if slope is None else slope)
    result: Tensor = _Known.apply(strength, damping, mean(*given) if found is None else found, *slopes)
    return result


class _Known(torch.autograd.Function):
    """A function of two scalars whose value and slopes are known."""

    @staticmethod
    def forward(ctx: Any, strength: Tensor, damping: Tensor, value: Tensor, *slopes: Tensor | None) -> Tensor:
        ctx.save_for_backward(*slopes)
        return value.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        found = (None if slope is None else (gradients[0] * slope).sum() for slope in ctx.saved_tensors)
        return *found, None, None, None
