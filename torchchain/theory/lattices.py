"""Band transfer of scalar lattices from the law of their masses alone: the ladder with the lattice's own site resolvent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.network.bands import band_turns, bands_of
from torchchain.network.lattices import uniform_stiffness
from torchchain.network.wavenumber import zone_of
from torchchain.theory.ladder import Waves, ladder_transfer
from torchchain.theory.law import Law, law_of
from torchchain.theory.medium import Levels
from torchchain.threads import single_thread

LATEST_TIME = 400.0  # beyond it the ladder averages over time, which was checked for chains alone
_TAILS = 3e-7, 1e-3  # probability of lighter masses than those whose frequencies end the spectrum
_SAME = 10  # digits to which levels are one


@dataclass(frozen=True, eq=False, kw_only=True)
class LatticeWaves(Waves):
    """The wavevectors of a lattice by their levels.

    Attributes:
        levels: squared frequencies of the ordered lattice.
        shares: of all wavevectors at each level in each band, (band, level).
    """

    levels: Levels
    shares: Tensor

    @property
    def ring(self) -> Levels:
        return self.levels

    def received(self, argument: Tensor) -> Tensor:
        squares = self.levels.squares
        inverse = squares[:, None] / (squares[:, None] - argument)
        return self.shares.to(argument) @ inverse


def lattice_transfer(
    disorder: Disorder, kind: str, shape: Sequence[int], n_bands: int, times: Any, sources: Sequence[int] | None = None
) -> Tensor:
    """Mean share of each source's energy in each shell of |q|, [source, time, receiver], of a scalar lattice with random masses.

    The coherent potential and its conserving ladder (:mod:`torchchain.theory.ladder`) know a lattice by its squared
    frequencies alone. Interference, which brings energy back to where it started (weakly in two dimensions), is left out.

    Args:
        disorder: of the masses.
        kind, shape: of a periodic lattice with motion "scalar", see :func:`torchchain.lattice`.
        n_bands: shells of |q|.
        times: (time,), up to 400.
        sources: bands, counted from 1, whose waves (:func:`torchchain.network.band_waves`) start; None for all.

    Raises:
        FieldError: for bands without a wave of their own, or times beyond 400.

    Example:
        >>> share = tc.theory.lattice_transfer(tc.Disorder(strength=0.2), "square", (12, 12), 4, [0.0, 5.0])
        >>> tuple(share.shape), torch.allclose(share.sum(-1), torch.ones(4, 2, dtype=torch.float64))
        ((4, 2, 4), True)
    """
    checks.instance("disorder", disorder, Disorder)
    times = checks.times("times", times).to(torch.float64)
    checks.first_bad("times", f"be at most {LATEST_TIME:g}", times, times > LATEST_TIME, "time")
    law = law_of(disorder)
    with single_thread(), torch.no_grad():
        waves = _waves(kind, tuple(shape), n_bands, sources)
        mean = ladder_transfer(law, waves, times, _edges(law, float(waves.levels.squares.max())))
        return mean / mean.sum(-1, keepdim=True)


def _waves(kind: str, shape: tuple[int, ...], n_bands: int, sources: Sequence[int] | None) -> LatticeWaves:
    bands = bands_of(kind, 1, n_bands)
    where, n = zone_of(kind, shape), math.prod(shape)
    squared = uniform_stiffness(kind, "scalar", 1.0, 0.0, where.wavevectors.numpy())[:, 0, 0]
    levels, level = np.unique(squared.round(_SAME), return_inverse=True)
    shell = torch.bucketize(where.lengths * (1 - 1e-12), bands.edges) - 1
    shares = torch.zeros(n_bands, len(levels), dtype=torch.float64)
    held = shell >= 0
    shares.index_put_(
        (shell[held], torch.from_numpy(level.reshape(-1))[held]),
        torch.tensor(1 / n, dtype=torch.float64),
        accumulate=True,
    )
    turns = band_turns(kind, shape, n_bands)
    chosen = [
        checks.integer("sources", s, 1, n_bands) - 1 for s in (range(1, n_bands + 1) if sources is None else sources)
    ]
    numbers = [int(np.ravel_multi_index(tuple(turns[s].tolist()), shape)) for s in chosen]
    return LatticeWaves(
        n, n_bands, torch.from_numpy(squared[numbers]), torch.tensor(chosen),
        levels=Levels(torch.from_numpy(levels), torch.from_numpy(np.bincount(level.reshape(-1)) / n)), shares=shares,
    )  # fmt: skip


def _edges(law: Law, highest: float) -> tuple[float, float]:
    """Frequencies that few modes exceed: those of the whole lattice if all masses were as light as few are."""
    below = law.weights.cumsum(0)
    first, late = (float(law.values[min(int((below < tail).sum()), len(below) - 1)]) for tail in _TAILS)
    return math.sqrt(highest / first), math.sqrt(highest / late)
