"""Lattices: chain, square, triangular, cubic and fcc, of unit spacing, mass and stiffness."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.network.networks import Network

_ROOT = math.sqrt(0.5)

PRIMITIVE: dict[str, tuple[tuple[float, ...], ...]] = {
    "chain": ((1.0,),),
    "square": ((1.0, 0.0), (0.0, 1.0)),
    "triangular": ((1.0, 0.0), (0.5, math.sqrt(0.75))),
    "cubic": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "fcc": ((0.0, _ROOT, _ROOT), (_ROOT, 0.0, _ROOT), (_ROOT, _ROOT, 0.0)),
}
"""Primitive vectors as rows."""

STEPS: dict[str, tuple[tuple[int, ...], ...]] = {
    "chain": ((1,),),
    "square": ((1, 0), (0, 1)),
    "triangular": ((1, 0), (0, 1), (-1, 1)),
    "cubic": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "fcc": ((1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 1, 0), (0, -1, 1), (1, 0, -1)),
}
"""Half of the nearest neighbors, in primitive vectors."""

BOUNDARIES = ("periodic", "fixed", "free")
MOST_PARTICLES = 10**8


@dataclass(frozen=True, eq=False)
class Lattice(Network):
    """A :class:`Network` whose particles stand on a lattice with one particle per cell; made by :func:`lattice`.

    Particle (i, j, ...), counted along the primitive vectors, has the number (i * shape[1] + j) * ... of row-major order.

    Attributes:
        kind: a key of ``PRIMITIVE``.
        shape: particles along each primitive vector.
        boundary: "periodic", "fixed" or "free" along each.
        steps: of every bond, (bond,): from its first end to the second by step s of ``STEPS`` for s < n, by its
            opposite for n + s, n being the number of steps.

    Example:
        >>> sheet = tc.lattice("square", (4, 6), motion="scalar")
        >>> sheet.kind, sheet.shape, sheet.is_periodic
        ('square', (4, 6), True)
    """

    kind: str = field(default="square", kw_only=True)
    shape: tuple[int, ...] = field(default=(), kw_only=True)
    boundary: tuple[str, ...] = field(default=(), kw_only=True)
    steps: Tensor = field(default_factory=lambda: torch.zeros(0, dtype=torch.int64), kw_only=True)

    @property
    def primitive(self) -> Tensor:
        """Primitive vectors as rows, (dimension, dimension)."""
        return torch.tensor(PRIMITIVE[self.kind], dtype=torch.float64).to(self.positions)

    @property
    def is_periodic(self) -> bool:
        return all(one == "periodic" for one in self.boundary)

    @property
    def is_uniform(self) -> bool:
        """Periodic with equal bonds, none removed: the stiffness is diagonal in wavenumber space."""
        full = len(STEPS[self.kind]) * self.n_particles
        return (
            self.is_periodic
            and self.n_bonds == full
            and all(_equal(x) for x in (self.stiffness, self.tension))
            and bool((self.lengths - 1).abs().max() < 1e-9)
        )

    def _other_bound(self, masses: Tensor) -> Tensor:
        """Of a uniform lattice the largest eigenvalue of K, over the smallest mass: exact without disorder."""
        if not self.is_uniform:
            return super()._other_bound(masses)
        squared = np.linalg.eigvalsh(dynamical_matrix(self, grid_wavevectors(self)))
        return squared.max() * (1 + 1e-12) / masses.amin((-2, -1))

    def _kept(self, keep: Tensor) -> dict[str, Any]:
        return super()._kept(keep) | {"steps": self.steps[torch.as_tensor(keep, device=self.steps.device)]}


def _equal(values: float | Tensor) -> bool:
    values = torch.as_tensor(values)
    return values.numel() < 2 or bool((values == values.flatten()[0]).all())


def extent_of(
    kind: str, shape: Sequence[int], boundary: str | Sequence[str]
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Shape and boundary along each axis, checked; see :func:`lattice`."""
    checks.choice("kind", kind, PRIMITIVE)
    d = len(PRIMITIVE[kind])
    if isinstance(shape, int) or not checks.is_collection(shape):
        raise checks.FieldTypeError(f"shape must be {d} integers for kind '{kind}', got {checks.shown(shape)}")
    extent = tuple(checks.integer("shape", a, 1) for a in shape)
    if len(extent) != d:
        raise checks.fail("shape", f"have {d} entries for kind '{kind}'", extent)
    if not isinstance(boundary, str) and not checks.is_collection(boundary):
        raise checks.FieldTypeError(f"boundary must be a string or one for each axis, got {checks.shown(boundary)}")
    walls = (boundary,) * d if isinstance(boundary, str) else tuple(boundary)
    for wall in walls:
        checks.choice("boundary", wall, BOUNDARIES)
    if len(walls) != d:
        raise checks.fail("boundary", f"be one or {d} for kind '{kind}'", walls)
    for a, wall in zip(extent, walls, strict=True):
        if wall == "periodic" and a < 3:
            raise checks.fail("shape", "be at least 3 along a periodic axis, where bonds would meet twice", extent)
    if math.prod(extent) > MOST_PARTICLES:
        raise checks.fail("shape", f"hold at most {MOST_PARTICLES} particles", extent)
    return extent, walls


def lattice(
    kind: str, shape: Sequence[int], motion: str = "vector", boundary: str | Sequence[str] = "periodic"
) -> Lattice:
    """A lattice of unit masses, spacing and nearest-neighbor stiffness.

    >>> ring = lattice("triangular", (4, 5))
    >>> ring.n_particles, ring.n_bonds
    (20, 60)

    Args:
        kind: "chain", "square", "triangular", "cubic" or "fcc".
        shape: particles along each primitive vector: rows at 60 degrees for "triangular", the vectors (0, 1, 1),
            (1, 0, 1), (1, 1, 0) over root 2 for "fcc".
        motion: "vector" (central forces, which leave "square" and "cubic" without resistance to shear) or "scalar".
        boundary: "periodic", "fixed" (bonds to immobile particles around the lattice) or "free"; one for all axes or one
            for each.

    Returns:
        Lattice in float64; ``dataclasses.replace(lattice, masses=..., stiffness=...)`` has others.

    Raises:
        FieldError: for an unknown kind, a shape of another dimension, or fewer than 3 particles along a periodic axis.
    """
    extent, walls = extent_of(kind, shape, boundary)
    primitive, d = np.array(PRIMITIVE[kind]), len(extent)
    n = math.prod(extent)
    sites = np.stack(np.unravel_index(np.arange(n), extent), axis=1)
    strides = np.array([math.prod(extent[a + 1 :]) for a in range(d)])
    firsts, ends, steps, images, outside = [], [], [], [], []
    half = len(STEPS[kind])
    every = [*STEPS[kind], *(tuple(-x for x in step) for step in STEPS[kind])]
    for s, step in enumerate(every):
        there = sites + step
        turns = np.zeros_like(there)
        beyond = np.zeros(n, bool)  # ends on an immobile particle
        gone = np.zeros(n, bool)  # leaves through a free face
        for a, wall in enumerate(walls):
            out = (there[:, a] < 0) | (there[:, a] >= extent[a])
            if wall == "periodic":
                turns[:, a] = np.floor_divide(there[:, a], extent[a])
                there[:, a] -= turns[:, a] * extent[a]
            elif wall == "fixed":
                beyond |= out
            else:
                gone |= out
        # A bond between particles is found from its first end, one to a wall from its only one.
        for held in (~beyond & ~gone & (s < half), beyond & ~gone):
            firsts.append(np.flatnonzero(held))
            ends.append(there[held] @ strides)
            images.append(turns[held])
            steps.append(np.full(held.sum(), s))
        ends[-1][:] = -1
        outside.append(there[held])
    first, end, image = np.concatenate(firsts), np.concatenate(ends), np.concatenate(images)
    anchors = None
    if "fixed" in walls:
        places, which = np.unique(np.concatenate(outside), axis=0, return_inverse=True)
        end[end < 0] = n + which.reshape(-1)
        anchors = torch.from_numpy(places @ primitive)
    box = None
    if "periodic" in walls:  # along axes with walls, a cell so long that nothing reaches its copy
        box = torch.from_numpy(
            primitive
            * np.array([a if w == "periodic" else 4 * (a + 2) for a, w in zip(extent, walls, strict=True)])[:, None]
        )
    return Lattice(
        masses=torch.ones(n, dtype=torch.float64),
        positions=torch.from_numpy(sites @ primitive),
        bonds=torch.from_numpy(np.stack([first, end], axis=1)),
        box=box,
        motion=motion,
        anchors=anchors,
        images=torch.from_numpy(image) if box is not None else None,
        kind=kind,
        shape=extent,
        boundary=walls,
        steps=torch.from_numpy(np.concatenate(steps)),
    )  # fmt: skip


def reciprocal(primitive: Tensor) -> Tensor:
    """Reciprocal vectors as rows: primitive @ reciprocal^T = 2 pi."""
    return 2 * math.pi * torch.linalg.inv(primitive).mT


def grid_wavevectors(network: Lattice) -> np.ndarray:
    """The wavevectors that fit into the lattice, in the order of its FFT, (particle, dimension); not folded."""
    turns = np.stack(np.unravel_index(np.arange(network.n_particles), network.shape), axis=1) / np.array(network.shape)
    return turns @ reciprocal(network.primitive.detach()).double().cpu().numpy()


def dynamical_matrix(network: Lattice, wavevectors: np.ndarray) -> np.ndarray:
    """:func:`uniform_stiffness` of a uniform lattice, (wavevector, component, component)."""
    stiffness, tension = (torch.as_tensor(x).detach().flatten()[0].item() for x in (network.stiffness, network.tension))
    return uniform_stiffness(network.kind, network.motion, stiffness, tension, wavevectors)


def uniform_stiffness(kind: str, motion: str, stiffness: float, tension: float, wavevectors: np.ndarray) -> np.ndarray:
    """K(q) of a lattice of equal bonds, (wavevector, component, component), real and symmetric.

    Sum over half of the neighbors of 2 C (1 - cos(q . r)).
    """
    primitive = np.array(PRIMITIVE[kind])
    vectors = np.array(STEPS[kind]) @ primitive
    weight = 2 * (1 - np.cos(np.asarray(wavevectors) @ vectors.T))
    if motion == "scalar":
        return stiffness * weight.sum(-1)[:, None, None]
    along = vectors[:, :, None] * vectors[:, None, :]
    across = np.eye(len(primitive)) - along
    return np.einsum("qs,sab->qab", weight, stiffness * along + tension * across)


def dispersion(network: Lattice, wavevectors: Tensor) -> Tensor:
    """Frequencies of the uniform lattice with unit masses at any wavevector, (*any, component), ascending.

    Args:
        network: periodic, with equal bonds.
        wavevectors: (*any, dimension), in radians per spacing.

    Raises:
        FieldError: for a lattice with unequal bonds.

    Example:
        >>> sheet = tc.lattice("square", (8, 8), motion="scalar")
        >>> tc.network.dispersion(sheet, torch.tensor([[torch.pi, 0.0]], dtype=torch.float64)).round(decimals=6).tolist()
        [[2.0]]
    """
    if not network.is_uniform:
        raise checks.fail("network", "be a periodic lattice of equal bonds for a dispersion relation", network.kind)
    wavevectors = checks.real_tensor("wavevectors", wavevectors)
    flat = wavevectors.reshape(-1, network.dimension).double().cpu().numpy()
    squared = np.linalg.eigvalsh(dynamical_matrix(network, flat)).clip(0)
    return torch.from_numpy(np.sqrt(squared)).to(wavevectors).reshape(*wavevectors.shape[:-1], -1)
