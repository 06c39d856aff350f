"""The theory's transfer of a ring, computed once for all that ask for the same times, and softened so that nothing is negative."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain.theory.ladder import Waves
from torchchain.theory.law import Law
from torchchain.theory.transfer import TheoryTransfer, transfer_of_law

SOFT = 1e-3
"""Energies of a band below this share of its mean are taken up smoothly, so that none is negative: an ensemble's mean of
definition "site" may be, by some 1e-4."""
FIRST_ROOM = 0.02
"""Distances in wavenumber are counted in units of the width of a line, or of this."""
MOST_KEPT = 8
"""Transfers of the theory that are kept: models of one ensemble are asked for the same times again and again."""

_kept: dict[tuple[Ring, tuple[float, ...]], TheoryTransfer] = {}
_one_at_a_time = threading.Lock()


@dataclass(frozen=True)
class Ring:
    """What the theory wants to know of chains, in numbers that can be compared.

    Attributes:
        values, weights: of the law, see :class:`torchchain.theory.Law`.
        n_particles, n_bands, tones: of the ring and its sources.
        dual: whether the law is that of the compliances, with equal masses.
        damping: of the contacts.
    """

    values: tuple[float, ...]
    weights: tuple[float, ...]
    n_particles: int
    n_bands: int
    tones: tuple[int, ...]
    dual: bool
    damping: float

    @property
    def distances(self) -> Tensor:
        """Logarithms of those of wavenumbers over the widths of lines in Born's approximation, xi^2 tan^2(k/2), from 0 to 1, [source, receiver]."""
        values, weights = (torch.tensor(x, dtype=torch.float64) for x in (self.values, self.weights))
        mean = float((weights * values).sum())
        spread = float((weights * (values - mean).square()).sum())
        k = 2 * math.pi / self.n_particles * torch.tensor(self.tones, dtype=torch.float64)
        width = spread * torch.tan(k.clamp(max=0.9 * math.pi) / 2).square() + FIRST_ROOM
        far = torch.asinh((k[:, None] - k).abs() / (width[:, None] + width))
        return far / far.max().clamp(min=1e-9)


def _derived(ring: Ring, times: Tensor) -> TheoryTransfer:
    """The theory's transfer at these times, increasing, or at more of them that were asked for before."""
    with _one_at_a_time:  # who asks for what is being computed waits for it
        for known, found in list(_kept.items()):
            if known[0] == ring and bool(torch.isin(times, found.times).all()):
                return found
        while len(_kept) >= MOST_KEPT:
            _kept.pop(next(iter(_kept)), None)
        law = Law(torch.tensor(ring.values, dtype=torch.float64), torch.tensor(ring.weights, dtype=torch.float64))
        waves = Waves.of_tones(ring.n_particles, ring.n_bands, ring.tones, ring.dual, ring.damping)
        found = _kept[ring, tuple(times.tolist())] = transfer_of_law(law, waves, times)
        return found


def derived(ring: Ring, times: Tensor) -> Tensor:
    """T0 [source, time, receiver], nowhere negative; times may be infinite."""
    times = times.detach().cpu().double()
    asked = torch.cat([times[times.isfinite()], times.new_zeros(1)]).unique()
    found = _derived(ring, asked)
    mean = found.mean[:, torch.searchsorted(found.times, times.clamp(max=float(asked[-1])))].clone()
    mean[:, times.isinf()] = found.long_time[:, None]
    return _positive(mean, ring, times)


def _positive(mean: Tensor, ring: Ring, times: Tensor) -> Tensor:
    rows, own = torch.arange(len(mean)), torch.tensor(ring.tones) - 1
    own = own // (ring.n_particles // 2 // ring.n_bands)
    total = mean.sum(-1, keepdim=True)
    moved = (total[..., 0] - mean[rows, :, own]).clamp(min=0)
    softened = (mean + (mean.square() + (SOFT / ring.n_bands * moved[..., None]).square()).sqrt()) / 2
    softened = softened * total / softened.sum(-1, keepdim=True).clamp(min=1e-300)
    start = torch.zeros_like(mean[:, 0])
    start[rows, own] = 1.0
    softened[:, times == 0] = start[:, None]
    return softened
