"""Numbers of networks laid out for the Chebyshev kernels: rows of a lattice, or neighbors listed for every particle."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain.network.lattices import PRIMITIVE, STEPS, Lattice
from torchchain.network.networks import Network

TILE = 512  # particles treated together, whose terms are added to the sums while they are in cache
WINDOW = 64  # particles sorted by their number of neighbors, so that processors foresee the ends of loops; divides TILE
DEEPEST, SWEPT = 8, 8e6  # steps of one sweep through memory, at most, and the bytes they may hold in cache
RENUMBER = 2_000  # particles from which a network is renumbered for the cache
NARROW = 40  # particles in a row below which loops along it do not pay
PAD = 1  # empty particles on either side of a row
Run = Callable[..., None]
"""Called with steps, last, begin, end, cells, sums, table, see :func:`torchchain.network.kernels.gathered`."""


class Gathered:
    """Neighbors listed for every particle; particles renumbered so that neighbors are near each other in memory.

    The kernel treats ``parts`` pieces of the network one by one.
    """

    def __init__(self, network: Network) -> None:
        n, c = network.n_particles, network.n_components
        bonds = network.bonds.cpu().numpy()
        b = np.arange(len(bonds))
        owner, end = np.concatenate([bonds[:, 0], bonds[:, 1]]), np.concatenate([bonds[:, 1], bonds[:, 0]])
        bond = np.concatenate([b, b])
        inside = owner < n
        owner, end, bond = owner[inside], np.minimum(end[inside], n), bond[inside]  # cell n is every anchor, at rest
        self.order = np.arange(n)
        if n > RENUMBER:
            near = end < n
            graph = scipy.sparse.coo_matrix(
                (np.ones(near.sum(), np.int8), (owner[near], end[near])), shape=(n, n)
            ).tocsr()
            self.order = scipy.sparse.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        neighbors = np.bincount(owner, minlength=n)[self.order]
        window = np.arange(n) // WINDOW
        sort = np.lexsort((-neighbors, window))
        self.order, neighbors = self.order[sort], neighbors[sort]
        place = np.empty(n + 1, np.int64)
        place[self.order], place[n] = np.arange(n), n
        owner, end = place[owner], place[end]
        sort = np.lexsort((end, owner))
        self.ends, self.bond = end[sort], bond[sort]
        self._offsets: dict[int, np.ndarray] = {}
        self.starts = np.concatenate([[0], np.cumsum(neighbors)]).astype(np.uint64)
        new = (np.diff(neighbors, prepend=-1) != 0) | (np.diff(window, prepend=-1) != 0)
        self.runs = np.append(np.flatnonzero(new), n)
        self.tiles = np.searchsorted(self.runs, np.append(np.arange(0, n, TILE), n))
        self.parts, self.n, self.components = len(self.tiles) - 1, n, c
        inside = self.ends < n
        self.lag = int(np.abs(self.ends // TILE - owner[sort] // TILE)[inside].max(initial=1))
        held = self.lag * TILE * (8 * (4 * c + 1) + len(self.ends) / n * (4 + 8 * c))
        self.depth = int(np.clip(SWEPT / held, 1, DEEPEST))
        self.masses = _flat(network.masses)[:, self.order]
        self.stiffness = _flat(network.bond_stiffness)
        self.across = _flat(network.bond_tension / network.lengths) if network.is_prestressed else None
        directions = network.directions.detach().double().cpu().numpy()
        self.directions = directions[self.bond] if c > 1 else np.zeros(0)

    def _ends(self, columns: int) -> np.ndarray:
        """The neighbors as offsets into cells with so many columns."""
        if columns not in self._offsets:
            kind = np.uint32 if (self.n + 1) * columns < 2**32 else np.uint64
            self._offsets[columns] = (self.ends * columns).astype(kind)
        return self._offsets[columns]

    def cells(self, fields: list[np.ndarray]) -> np.ndarray:
        """Scratch with T_0 in it, from fields (particle, component)."""
        cells = np.zeros((2, self.n + 1, len(fields) * self.components))
        for r, values in enumerate(fields):
            cells[0, :-1, r * self.components : (r + 1) * self.components] = values[self.order]
        return cells

    def sums(self, outputs: int) -> np.ndarray:
        """Zeros for the sums."""
        return np.zeros((outputs, 2, self.n, self.components))

    def bind(self, member: int, frequency: float) -> Run:
        """The kernel with the numbers of a member of the batch."""
        from torchchain.network import kernels  # imports Numba

        weight = 4 / frequency**2 / self.masses[member]
        stiff, across, directions = self.stiffness[member][self.bond], np.zeros(0), self.directions
        if self.components > 1:
            if self.across is not None:
                across = self.across[member][self.bond]
                stiff = stiff - across
            directions = (directions * np.sqrt(np.abs(stiff))[:, None]).reshape(-1)
            stiff = np.sign(stiff) if stiff.min(initial=0) < 0 else np.zeros(0)

        def scratch(cells: np.ndarray) -> tuple[Any, ...]:
            columns, sweep = cells.shape[2], (self.depth, self.lag, self.tiles, self.runs, self.starts)
            return (np.empty((TILE, columns)), *sweep, self._ends(columns))

        def kernel(cells: np.ndarray) -> Any:
            fields = cells.shape[2] // self.components
            return kernels.gathered(self.components, fields, len(stiff) > 0, len(across) > 0)

        return _bound(kernel, scratch, weight, stiff, directions, across)

    def read(self, sums: np.ndarray) -> np.ndarray:
        """The sums as (output, 2, particle, component)."""
        out = np.empty_like(sums)
        out[:, :, self.order] = sums
        return out


class Rows:
    """Rows of a lattice, whose neighbors are rows; with the methods of :class:`Gathered`."""

    def __init__(self, network: Lattice) -> None:
        *front, self.width = network.shape
        self.parts = math.prod(front)
        self.components, n = network.n_components, network.n_particles
        primitive, half = np.array(PRIMITIVE[network.kind]), np.array(STEPS[network.kind])
        steps = np.concatenate([half, -half])
        rows = np.stack(np.unravel_index(np.arange(self.parts), front), axis=1) if front else np.zeros((1, 0), np.int64)
        self.neighbors = np.empty((self.parts, len(steps)), np.int64)
        for s, step in enumerate(steps):
            there, at_rest = rows + step[:-1], np.zeros(self.parts, bool)
            for a, extent in enumerate(front):
                if network.boundary[a] == "periodic":
                    there[:, a] %= extent
                else:
                    at_rest |= (there[:, a] < 0) | (there[:, a] >= extent)
            number = np.ravel_multi_index(tuple(there.clip(0).T % np.array(front)[:, None]), front) if front else 0
            self.neighbors[:, s] = np.where(at_rest, self.parts, number)
        self.shifts = steps[:, -1].astype(np.int64)
        self.wrap = network.boundary[-1] == "periodic"
        vectors = steps @ primitive
        directions = vectors if self.components > 1 else np.ones((len(steps), 1))
        # No step of these lattices has three components: the two largest, the second perhaps zero.
        self.axes = np.argsort(-np.abs(directions), axis=1, kind="stable")[:, :2]
        self.axes = self.axes if self.components > 1 else np.zeros((len(steps), 2), np.int64)
        self.ratios = np.take_along_axis(directions, self.axes, axis=1)
        self.ratios[np.abs(self.ratios) < 1e-12] = 0.0
        if self.components == 1:
            self.ratios[:, 1] = 0.0
        self.masses = _flat(network.masses)
        self.stiffness = _flat(network.bond_stiffness)
        prestressed = network.is_prestressed and self.components > 1
        self.across = _flat(network.bond_tension / network.lengths) if prestressed else None
        bonds, way = network.bonds.cpu().numpy(), network.steps.cpu().numpy()
        inside = bonds[:, 1] < n
        opposite = (way + len(half)) % len(steps)
        self.slot = np.concatenate([way * n + bonds[:, 0], (opposite * n + bonds[:, 1])[inside]])
        self.bond = np.concatenate([np.arange(len(bonds)), np.flatnonzero(inside)])
        self.full = len(self.slot) == n * len(steps)

    def _slots(self, values: np.ndarray) -> np.ndarray:
        """Values per bond as (step, row, width), or (step, 1, 1) where all are equal."""
        steps = len(self.shifts)
        if self.full and values.min() == values.max():
            return np.full((steps, 1, 1), values[0])
        slots = np.zeros(steps * self.parts * self.width)
        slots[self.slot] = values[self.bond]
        return slots.reshape(steps, self.parts, self.width)

    def cells(self, fields: list[np.ndarray]) -> np.ndarray:
        c, w = self.components, self.width
        cells = np.zeros((2, len(fields) * c, self.parts + 1, w + 2 * PAD))
        for r, values in enumerate(fields):
            inner = cells[0, r * c : (r + 1) * c, :-1]
            inner[..., PAD:-PAD] = values.T.reshape(c, self.parts, w)
            if self.wrap:
                inner[..., :PAD] = inner[..., w : w + PAD]
                inner[..., -PAD:] = inner[..., PAD : 2 * PAD]
        return cells

    def sums(self, outputs: int) -> np.ndarray:
        return np.zeros((outputs, 2, self.components, self.parts, self.width))

    def bind(self, member: int, frequency: float) -> Run:
        from torchchain.network import kernels  # imports Numba

        weight = (4 / frequency**2 / self.masses[member]).reshape(self.parts, self.width)
        stiff, across = self._slots(self.stiffness[member]), np.zeros((0, 1, 1))
        if self.across is not None:
            across = self._slots(self.across[member])
            stiff, across = (np.ascontiguousarray(x) for x in np.broadcast_arrays(stiff - across, across))

        def scratch(cells: np.ndarray) -> tuple[np.ndarray, ...]:
            return tuple(np.empty((n, self.width)) for n in (len(self.shifts), 1, 1))

        return _bound(
            lambda cells: kernels.rows, scratch, weight, self.neighbors, self.shifts, stiff, self.axes, self.ratios,
            across, PAD, self.components, self.wrap,
        )  # fmt: skip

    def read(self, sums: np.ndarray) -> np.ndarray:
        return np.moveaxis(sums, 2, -1).reshape(len(sums), 2, -1, self.components)


def _bound(kernel: Callable[[np.ndarray], Any], scratch: Callable[[np.ndarray], tuple[Any, ...]], *numbers: Any) -> Run:
    """A kernel with the numbers of a network, and scratch of its own in every call, which threads make side by side."""

    def run(
        steps: tuple[int, int], last: int, begin: int, end: int, cells: np.ndarray, sums: np.ndarray, table: np.ndarray
    ) -> None:
        kernel(cells)(steps, last, begin, end, cells, sums, table, *scratch(cells), *numbers)

    return run


def layout_of(network: Network) -> Gathered | Rows:
    """The fastest layout that the network has."""
    wide = isinstance(network, Lattice) and network.n_bonds > 0 and network.shape[-1] >= NARROW
    return Rows(network) if wide and _is_straight(network) else Gathered(network)  # type: ignore[arg-type]


def _is_straight(network: Lattice) -> bool:
    """Whether the bonds have the directions of the lattice: its positions have not been moved."""
    vectors = torch.tensor(STEPS[network.kind]).to(network.primitive) @ network.primitive
    vectors = torch.cat([vectors, -vectors])[network.steps]
    return bool((network.bond_vectors - vectors).abs().max() < 1e-9)


def _flat(values: Tensor) -> np.ndarray:
    return values.detach().double().reshape(-1, values.shape[-1]).cpu().numpy()
