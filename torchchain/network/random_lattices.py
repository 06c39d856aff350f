"""Lattices with random masses, stiffnesses, missing bonds and places: what a scene draws its realizations from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import Disorder, State
from torchchain.network.bands import ShellBands, band_turns, band_waves, bands_of
from torchchain.network.disorder import displaced, kept_bonds
from torchchain.network.energy import distances
from torchchain.network.lattices import PRIMITIVE, Lattice, extent_of, lattice
from torchchain.network.networks import MOTIONS

MOST_SHELLS = 8  # per polarization, where nobody says how many


@dataclass(frozen=True)
class RandomLattices:
    """An ensemble of lattices of one kind and shape; realization i of a seed is always the same one.

    >>> from torchchain.chain import Disorder
    >>> law = RandomLattices("triangular", (6, 6), masses=Disorder(strength=0.2))
    >>> law.draw([0, 1], seed=0).masses.shape, law.default_bands
    (torch.Size([2, 36]), 6)

    Attributes:
        kind, shape, motion, boundary: see :func:`torchchain.lattice`; one boundary along all axes.
        masses, stiffness: what the factors on masses and stiffnesses are drawn from; None leaves them.
        removed_bonds: probability that a bond is missing.
        moved: standard deviation of each coordinate of the particles' places, in spacings; bonds rest at their lengths.
        damping: of every bond.
        opposite_pairs: see :meth:`torchchain.Disorder.masses`.

    Raises:
        FieldError, FieldTypeError: for a field out of range.
    """

    kind: str
    shape: tuple[int, ...]
    motion: str = "vector"
    boundary: str = "periodic"
    masses: Disorder | None = None
    stiffness: Disorder | None = None
    removed_bonds: float = 0.0
    moved: float = 0.0
    damping: float = 0.0
    opposite_pairs: bool = False

    def __post_init__(self) -> None:
        checks.choice("lattice", self.kind, PRIMITIVE)
        object.__setattr__(self, "shape", extent_of(self.kind, self.shape, self.boundary)[0])
        checks.choice("motion", self.motion, MOTIONS)
        removed = checks.number("removed_bonds", self.removed_bonds, at_least=0, below=1)
        moved = checks.number("position_disorder", self.moved, at_least=0, at_most=0.3)
        if moved and self.motion == "scalar":
            raise checks.fail("position_disorder", "be zero for motion 'scalar', which has no directions", moved)
        object.__setattr__(self, "removed_bonds", removed)
        object.__setattr__(self, "moved", moved)

    @property
    def ordered(self) -> Lattice:
        """The lattice without disorder."""
        return _ordered(self.kind, self.shape, self.motion, self.boundary)

    @property
    def n_particles(self) -> int:
        return math.prod(self.shape)

    @property
    def n_components(self) -> int:
        """Displacements per particle."""
        return len(self.shape) if self.motion == "vector" else 1

    @property
    def n_bonds(self) -> int:
        return self.ordered.n_bonds

    @property
    def is_ordered(self) -> bool:
        """Whether every realization is the same lattice."""
        random = any(law is not None and law.strength > 0 for law in (self.masses, self.stiffness))
        return not random and self.removed_bonds == 0 and self.moved == 0

    def bands(self, n_bands: int) -> ShellBands:
        """The bands, if a wave starts in each of them."""
        found = bands_of(self.kind, self.n_components, n_bands)
        if self.boundary != "periodic":
            raise checks.fail("boundary", "be 'periodic' for bands of wavevectors", repr(self.boundary))
        band_turns(self.kind, self.shape, found.n_shells)
        return found

    @property
    def default_bands(self) -> int:
        """As many shells, up to 8, as all hold a wave to start with, times the polarizations."""
        polarizations = len(bands_of(self.kind, self.n_components, 2).polarizations)
        for shells in range(MOST_SHELLS, 1, -1):
            try:
                band_turns(self.kind, self.shape, shells)
            except checks.FieldError:
                continue
            return shells * polarizations
        return polarizations

    def draw(self, realizations: Sequence[int], seed: int) -> Lattice:
        """The lattices of some realizations, counted from 0, masses (realization, particle).

        Places have no batch axes, so that lattices with moved particles come one at a time.
        """
        network, numbers = self.ordered, list(realizations)
        changes: dict[str, Any] = {}
        masses = network.masses.expand(len(numbers), -1)
        if self.masses is not None:
            masses = self.masses.masses(self.n_particles, numbers, seed, self.opposite_pairs)
        if self.stiffness is not None:
            changes["stiffness"] = self.stiffness.stiffnesses(self.n_bonds, numbers, seed, self.opposite_pairs)
        if self.removed_bonds:
            kept = kept_bonds(self.n_bonds, self.removed_bonds, numbers, seed)
            changes["stiffness"] = kept * changes.get("stiffness", 1.0)
            changes["damping"] = kept * self.damping
        elif self.damping:
            changes["damping"] = self.damping
        made = replace(network, masses=masses, **changes)
        if not self.moved:
            return made
        if len(numbers) != 1:
            raise checks.fail("realizations", "come one at a time where particles are moved", len(numbers))
        return displaced(made, self.moved, numbers[0], seed)

    def kick(self, network: Lattice, site: int, velocity: float) -> State:
        """One particle, counted from 1, struck along the first axis, (*batch, particle, component)."""
        shape = (*network.batch_shape, self.n_particles, self.n_components)
        speed = torch.zeros(shape, dtype=network.masses.dtype, device=network.masses.device)
        speed[..., checks.integer("excitation.site", site, 1, self.n_particles) - 1, 0] = velocity
        return State(torch.zeros_like(speed), speed)

    def waves(self, network: Lattice, n_bands: int, chosen: Sequence[int], amplitude: float, phase: str) -> State:
        """The plane waves of some bands, counted from 1, (*batch, wave, particle, component)."""
        return band_waves(network, n_bands, amplitude, phase, chosen).state

    def ring_edges(self, site: int) -> Tensor:
        """Edges of rings one spacing wide about a particle that hold every particle, (ring + 1,)."""
        farthest = float(distances(self.ordered, site).max()) + 5 * self.moved
        return torch.arange(math.floor(farthest + 0.5) + 2, dtype=torch.float64) - 0.5


@lru_cache(maxsize=8)
def _ordered(kind: str, shape: tuple[int, ...], motion: str, boundary: str) -> Lattice:
    return lattice(kind, shape, motion, boundary)
