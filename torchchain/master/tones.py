"""The transfer from single tones, released at rest or kicked, in the form of :mod:`torchchain.master.compact` tone by tone.

The odds of finding energy of tone n in tone m rather than still in n are, summed over the tones m of a band,

    D_nm(t) exp(p(u, v, tau)),    and in n itself    exp(q(n, tau)).

D is second-order perturbation theory: with h the response to a beat and c the variance of the disorder for each tone,

    released  c w w' (h(w - w') - h(w + w')),    kicked  c w^2 (h(w - w') + h(w + w')).

Where little energy is ever scattered, at long waves, it is exact and nothing is left to fit: p and q are multiplied by
S / (S + S0), with S the odds of all other tones in the end.

A kick also gives a ring of random masses a momentum, of mean square (variance of the masses) x (energy), which stays while the
wave's own part of it decays: the share (variance / N) (1 - cos(w t) exp(-g t)) of the energy goes to k = 0, which is in no band.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchchain.ensemble.starts import KINDS
from torchchain.master.logistic import Regression
from torchchain.master.normal import Equations
from torchchain.master.polynomials import clock_of, of_pairs, polynomials, power, terms
from torchchain.master.waves import WIDTH, poles, scattered
from torchchain.threads import kept_property

ONSET = 0.1
"""S0, chosen among 0.03, 0.1 and 0.3 on two ensembles at disorder 0.3."""


@dataclass(frozen=True, eq=False)
class Tones:
    """The tones of a ring as waves of an effective medium.

    Attributes:
        frequency, decay: of tones 1 to N / 2, (tone,), float64.
        coupling: variance of the disorder for each tone, ().
        n_bands: B.
        rigid: variance of the masses over N, (), the share of a kick's energy that goes to k = 0.
        onset: S0, ().
    """

    frequency: Tensor
    decay: Tensor
    coupling: Tensor
    n_bands: int
    rigid: Tensor
    onset: Tensor

    @classmethod
    def of(cls, n_particles: int, n_bands: int, strength: float, masses: float = 0.0) -> Tones:
        """Those of rings whose disorder has a standard deviation, in the self-consistent Born approximation.

        Args:
            n_particles, n_bands: N and B.
            strength: standard deviation of the masses, and of the contacts if they vary too.
            masses: of the masses alone.
        """
        tones = np.arange(1, n_particles // 2 + 1)
        z = poles(2 * np.sin(np.pi / n_particles * tones), strength)
        coupling = torch.tensor(strength**2 / n_particles, dtype=torch.float64)
        rigid, onset = coupling.new_tensor(masses**2 / n_particles), coupling.new_tensor(ONSET)
        return cls(torch.from_numpy(z.real.copy()), torch.from_numpy(-WIDTH * z.imag), coupling, n_bands, rigid, onset)

    def __len__(self) -> int:
        return len(self.frequency)

    @property
    def width(self) -> int:
        """Tones of a band."""
        return len(self) // self.n_bands

    def band(self, numbers: Tensor) -> Tensor:
        """The band of each tone, both counted from 0."""
        return numbers // self.width

    def odds(self, kind: str, numbers: Tensor, times: Tensor) -> Tensor:
        """D summed over the tones of each band but the source itself, (source, time, band); times may be infinite.

        Args:
            kind: of :data:`KINDS`.
            numbers: of the sources, from 0, (source,).
            times: (time,).
        """
        w, g = self.frequency[numbers][:, None, None], self.decay[numbers][:, None, None]
        rate = g + self.decay[:, None]
        each = self.coupling * scattered(w, self.frequency[:, None], rate, times, kind == KINDS[1])
        each = each * (torch.arange(len(self), device=times.device)[:, None] != numbers[:, None, None])
        return each.reshape(len(numbers), self.n_bands, self.width, len(times)).sum(2).transpose(1, 2)

    def shapes(self, numbers: Tensor, degrees: tuple[int, int, int]) -> Tensor:
        """Polynomials of place and distance, (source, slot, term): slots are the bands, and last the source's own tone."""
        every = torch.arange(len(self), device=self.frequency.device)
        place = (every.to(self.frequency) + 0.5) / len(self)
        whole = self._distance(every)
        low, high = whole[whole > 0].min(), whole.max()
        distance = ((self._distance(numbers) - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
        middle = (place[numbers][:, None] + place.reshape(self.n_bands, -1).mean(1)) / 2
        between, own = of_pairs(middle, distance, degrees), polynomials(place[numbers], degrees[0])
        upper = torch.cat([between, between.new_zeros(*between.shape[:-1], own.shape[-1])], -1)
        lower = torch.cat([own.new_zeros(len(own), between.shape[-1]), own], -1)
        end = self.odds(KINDS[0], numbers, place.new_full((1,), math.inf)).sum((1, 2))
        return torch.cat([upper, lower[:, None]], dim=1) * (end / (end + self.onset))[:, None, None]

    def lost(self, numbers: Tensor, times: Tensor) -> Tensor:
        """Share of a kick's energy at k = 0, (source, time); times may be infinite."""
        w, g, t = self.frequency[numbers][:, None], self.decay[numbers][:, None], times.clamp(max=1e300)
        return self.rigid * (1 - torch.cos(w * t) * torch.exp(-g * t))

    def _distance(self, numbers: Tensor) -> Tensor:
        """Mean logarithmic distance to the tones of each band but the source, the nearest counting most, (source, band)."""
        gap = (self.frequency[numbers][:, None] - self.frequency).abs()
        rate = self.decay[numbers][:, None] + self.decay
        weight = (torch.arange(len(self), device=gap.device) != numbers[:, None]) / (gap**2 + rate**2)
        far, total = (
            x.reshape(len(numbers), self.n_bands, self.width).sum(-1)
            for x in (torch.asinh(gap / rate) * weight, weight)
        )
        return far / total.clamp(min=1e-300)


def shares(
    tones: Tones, kind: str, degrees: tuple[int, int, int], coefficients: Tensor, numbers: Tensor, times: Tensor
) -> Tensor:
    """T (source, time, band) of some sources: odds over their sum, never negative; of kicks, over that and what is at k = 0."""
    moved = power(tones.shapes(numbers, degrees), times, coefficients, terms(degrees).held)
    moved = torch.cat([tones.odds(kind, numbers, times) * moved[..., :-1], moved[..., -1:]], -1)
    moved = moved / moved.sum(-1, keepdim=True)
    own = torch.nn.functional.one_hot(tones.band(numbers), tones.n_bands).to(moved)
    found = moved[..., :-1] + own[:, None] * moved[..., -1:]
    return found * (1 - tones.lost(numbers, times))[..., None] if kind == KINDS[1] else found


class ToneRegression(Regression):
    """A logistic regression for :func:`torchchain.master.logistic.solve`: measured T of some tones and times.

    Its odds are those of slots: the bands, and last the source's own tone.

    Args:
        tones, kind, degrees, numbers, times: see :func:`shares`.
        data: T, (source, time, band), of rows that add up to 1.
        weight: inverse of the error, (source, time).
    """

    def __init__(
        self, tones: Tones, kind: str, degrees: tuple[int, int, int], numbers: Tensor, times: Tensor, data: Tensor,
        weight: Tensor,
    ) -> None:  # fmt: skip
        odds, shape = tones.odds(kind, numbers, times), tones.shapes(numbers, degrees)
        odds = torch.cat([odds, torch.ones_like(odds[..., :1])], -1)
        super().__init__(
            odds.numpy(), shape.numpy(), polynomials(clock_of(times), degrees[2]).numpy(), degrees, data.numpy(), weight.numpy()
        )  # fmt: skip
        self._own = np.arange(len(numbers)), tones.band(numbers).numpy()

    @kept_property
    def equations(self) -> Equations:
        size = len(terms(self.degrees).heads)
        return Equations(self.shape[:, :-1, :size], self.shape[:, -1, size:], self.clock, self.degrees)

    def _moved(self, slots: np.ndarray) -> np.ndarray:
        return slots[..., :-1]

    def _bands(self, slots: np.ndarray) -> np.ndarray:
        """The source's own tone added to its band, (source, time, band)."""
        bands = slots[..., :-1].copy()
        bands[self._own[0], :, self._own[1]] += slots[..., -1]
        return bands
