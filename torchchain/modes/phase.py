"""A guard for exact methods: the phase w t is known only to its rounding, whatever the method does with it."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchchain import checks

DOUBTFUL, LOST = 1e-3, 0.1
"""w t eps from which the phases are doubtful, and from which they mean nothing.

An eigen-solver's frequencies are off by some eps of the highest; the states' error is 1 to 15 times w t eps on chains of
256 (``experiments/failure_map.py``).
"""


class PhaseWarning(UserWarning):
    """An evolution so long that rounding has blurred its phases."""


def check(times: Tensor, frequency: Tensor, dtype: torch.dtype) -> None:
    """A warning or an error where rounding has blurred the phases of the fastest mode.

    Args:
        times: (time,).
        frequency: of the fastest mode or of all, (*batch,) or (*batch, mode).
        dtype: in which the phases are computed.

    Raises:
        FieldError: from w t eps = 0.1 on.

    Warns:
        PhaseWarning: from w t eps = 0.001 on.
    """
    if checks.is_transformed(frequency) or checks.is_transformed(times):
        return
    eps = torch.finfo(dtype).eps
    highest = frequency.detach().amax().item()
    end = times.detach().amax().item()
    blur = highest * end * eps
    if not blur < LOST:
        raise checks.fail(
            "times",
            f"be less than {LOST / (highest * eps):.3g}, where rounding in {_name(dtype)} has blurred the phases of "
            f"w_max = {highest:.4g} (w t eps < {LOST:g})",
            end,
        )
    if blur >= DOUBTFUL:
        remedy = "; use float64" if dtype == torch.float32 else ""
        warnings.warn(
            f"rounding in {_name(dtype)} blurs the phases of w_max = {highest:.4g} at time {end:g}: w t eps = {blur:.1e}, "
            f"and states are off by up to ten times that{remedy}",
            PhaseWarning,
            stacklevel=4,
        )


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
