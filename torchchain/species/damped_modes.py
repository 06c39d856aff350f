"""Complex modes of damped chains: frequency and decay of each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.evolvers.damped import undamped


@dataclass(frozen=True, eq=False)
class DampedModes:
    """Modes u = s exp(-(decay + i frequency) t) of M u'' = -K u - D u'.

    Attributes:
        frequencies: w, (*batch, mode), ascending; those of overdamped motions are 0, and there are two for each.
        decays: of the amplitude, (*batch, mode); energies decay at twice that.

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64), boundary="fixed", damping=0.1)
        >>> modes = tc.species.damped_modes(chain)
        >>> w2 = (2 * torch.sin(torch.arange(1, 9, dtype=torch.float64) * torch.pi / 18)).square()
        >>> torch.allclose(modes.decays, 0.05 * w2), torch.allclose(modes.frequencies.square() + modes.decays.square(), w2)
        (True, True)
    """

    frequencies: Tensor
    decays: Tensor


def damped_modes(chain: Chain) -> DampedModes:
    """Complex modes of linear chains with contact damping, from the generator of their motion in real modes.

    Args:
        chain: linear contacts, masses (*batch, particle).

    Returns:
        DampedModes without the rigid motion of a ring. Where a motion is overdamped it counts as two modes of frequency 0,
        so that the number of modes can exceed that of particles, and the batch must agree on it.

    Raises:
        FieldError: for Hertz contacts, or chains of a batch with different numbers of overdamped motions.

    Example:
        >>> mixture = tc.species.Mixture((tc.species.Species("soft", stiffness=0.2, damping=0.1), tc.species.Species("stiff")))
        >>> modes = tc.species.damped_modes(mixture.chain(16, 1, seed=0))
        >>> bool((modes.decays > 0).all()), tuple(modes.decays.shape)
        (True, (1, 15))
    """
    checks.instance("chain", chain, Chain)
    if chain.contact != "linear":
        raise checks.fail("contact", "be 'linear' for modes", repr(chain.contact))
    modes, matrix = undamped(chain)
    values = torch.linalg.eigvals(matrix)
    scale = torch.finfo(matrix.dtype).eps ** 0.5 * modes.frequencies.amax(-1, keepdim=True)
    kept = values.imag > -scale  # one of each conjugate pair, and both of an overdamped motion
    kept &= ~((values.imag.abs() <= scale) & (values.real > scale))
    counts = kept.sum(-1)
    first = int(counts.flatten()[0])
    checks.first_bad("chain", f"have {first} modes like the first of the batch", counts, counts != first, "realization")
    found = values[kept].reshape(*counts.shape, first)
    order = (found.imag.clamp(min=0)).argsort(-1)
    found = found.gather(-1, order)
    return DampedModes(torch.where(found.imag > scale, found.imag, 0.0), -found.real)
