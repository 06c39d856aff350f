"""Networks of particles and bonds in one, two and three dimensions, and the forces in them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain import checks
from torchchain.network import bonds

MOTIONS = ("vector", "scalar")
SWEEPS = 8  # of the bound's power iteration


@dataclass(frozen=True, eq=False)
class Network:
    """Particles joined by bonds: the linear motion about a state of rest.

    A bond of unit vector n, length L, stiffness k and tension T pulls its ends together with

        C (u_j - u_i),    C = k n n^T + (T / L) (1 - n n^T)    (motion "vector"),
        k (u_j - u_i)                                          (motion "scalar": one displacement per particle),

    so that the force on all particles is -K u with K = A^T C A, A being the incidence of bonds and particles. A tension
    T > 0 pulls, as in a stretched rope, and adds to the stiffness across the bond; T < 0 pushes, as in a contact of two
    grains, and takes from it (Alexander, Phys. Rep. 296, 65, 1998, Section 3). K is never negative for T >= 0.

    Displacements, velocities and forces have the axes (*batch, *any, particle, component): as many components as
    dimensions for motion "vector", one for "scalar".

    >>> import torch
    >>> triangle = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.75**0.5]], dtype=torch.float64)
    >>> network = Network(torch.ones(3), triangle, [[0, 1], [1, 2], [2, 0]])
    >>> network.n_particles, network.n_bonds, network.dimension
    (3, 3, 2)

    Attributes:
        masses: (*batch, particle), positive.
        positions: (particle, dimension), one to three dimensions.
        bonds: (bond, 2), the particles each joins, counted from 0; numbers from n_particles on are anchors.
        stiffness: k, a number, (bond,) or (*batch, bond), not negative; a bond of stiffness 0 is no bond.
        tension: T, a number, (bond,) or (*batch, bond); zero for motion "scalar".
        box: None; the periods (dimension,), infinite along directions that are not periodic; or the vectors of the
            periodic cell as rows (dimension, dimension).
        motion: "vector" or "scalar".
        damping: of each bond's change of length (of its difference, for "scalar"), force per velocity, like stiffness.
        anchors: immobile points that bonds may end at, (anchor, dimension); None for none.
        images: integers (bond, dimension): bond (i, j) ends at the copy of j moved by images @ box; None for the nearest.

    Raises:
        FieldError, FieldTypeError: for bonds of a particle with itself, doubled, out of range, of length zero or not
            shorter than half the box (where ``images`` does not say which copy is meant), and for values out of range.
    """

    masses: Tensor
    positions: Tensor
    bonds: Tensor
    stiffness: float | Tensor = 1.0
    tension: float | Tensor = 0.0
    box: Tensor | None = None
    motion: str = "vector"
    damping: float | Tensor = 0.0
    anchors: Tensor | None = None
    images: Tensor | None = None
    bond_vectors: Tensor = field(init=False, repr=False)
    lengths: Tensor = field(init=False, repr=False)
    directions: Tensor = field(init=False, repr=False)

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        masses = checks.real_tensor("masses", self.masses)
        if masses.ndim == 0 or masses.shape[-1] < 1:
            raise checks.fail("masses", "hold particles on the last axis", masses)
        checks.first_bad("masses", "be positive", masses, masses <= 0, "particle")
        put("masses", masses)
        positions = checks.real_tensor("positions", self.positions).to(masses)
        n = masses.shape[-1]
        if positions.ndim != 2 or positions.shape[0] != n or positions.shape[1] not in (1, 2, 3):
            raise checks.fail(
                "positions",
                f"have shape ({n}, 1), ({n}, 2) or ({n}, 3) like the masses",
                positions,
            )
        put("positions", positions)
        checks.choice("motion", self.motion, MOTIONS)
        put("box", None if self.box is None else bonds.checked_box(self.box, positions))
        if self.anchors is not None:
            anchors = checks.real_tensor("anchors", self.anchors).to(masses)
            if anchors.ndim != 2 or anchors.shape[1] != self.dimension:
                raise checks.fail("anchors", f"have shape (anchor, {self.dimension})", anchors)
            put("anchors", anchors)
        found, images = bonds.checked_bonds(self.bonds, self.images, n, self.n_anchors, positions, self.box is not None)
        put("bonds", found)
        put("images", images)
        put("bond_vectors", self._bond_vectors())
        lengths = self.bond_vectors.square().sum(-1).sqrt()
        scale = torch.finfo(masses.dtype).eps * max(float(self.points.detach().abs().max()), 1e-300)
        what = "length of bonds" if self.box is None else "length of bonds in the periodic box"
        checks.first_bad(what, "be positive", lengths, lengths <= scale, "bond")
        put("lengths", lengths)
        put("directions", self.bond_vectors / lengths[:, None])
        if self.box is not None and self.images is None:
            bonds.check_shorter_than_half(lengths, self.box)
        bonds.check_doubles(self.bonds, self.images)
        for name in ("stiffness", "tension", "damping"):
            put(name, self._per_bond(name, getattr(self, name), signed=name == "tension"))
        if self.motion == "scalar" and bool((torch.as_tensor(self.tension) != 0).any()):
            worst = torch.as_tensor(self.tension).abs().amax().item()
            raise checks.fail(
                "tension", "be zero for motion 'scalar', whose stiffness is all there is", f"up to {worst:g}"
            )

    def _bond_vectors(self) -> Tensor:
        points = self.points
        vectors = points[self.bonds[:, 1]] - points[self.bonds[:, 0]]
        if self.box is None:
            return vectors
        if self.images is None:
            return self.nearest_image(vectors)
        return vectors + bonds.moved(self.images, self.box)

    def _per_bond(self, name: str, value: float | Tensor, signed: bool) -> Tensor:
        value = checks.real_tensor(name, value).to(self.masses)
        if not signed:
            checks.first_bad(name, "not be negative", value, value < 0, "bond")
        shape: tuple[int, ...] = (*self.batch_shape, self.n_bonds)
        if value.ndim == 0:
            return value.expand(self.n_bonds)
        if tuple(value.shape) not in (shape, shape[-1:]):
            raise checks.fail(name, f"be a number or have shape {shape[-1:]} or {shape}", value)
        return value

    @property
    def n_particles(self) -> int:
        return self.masses.shape[-1]

    @property
    def n_bonds(self) -> int:
        return len(self.bonds)

    @property
    def n_anchors(self) -> int:
        return 0 if self.anchors is None else len(self.anchors)

    @property
    def dimension(self) -> int:
        return self.positions.shape[1]

    @property
    def n_components(self) -> int:
        """Displacements per particle."""
        return self.dimension if self.motion == "vector" else 1

    @property
    def n_unknowns(self) -> int:
        return self.n_particles * self.n_components

    @property
    def batch_shape(self) -> torch.Size:
        return self.masses.shape[:-1]

    @property
    def points(self) -> Tensor:
        """Positions of particles and anchors, (particle and anchor, dimension)."""
        return self.positions if self.anchors is None else torch.cat([self.positions, self.anchors])

    @property
    def bond_stiffness(self) -> Tensor:
        """k of every bond, (*batch, bond)."""
        return torch.as_tensor(self.stiffness).expand(*self.batch_shape, self.n_bonds)

    @property
    def bond_tension(self) -> Tensor:
        """T of every bond, (*batch, bond)."""
        return torch.as_tensor(self.tension).expand(*self.batch_shape, self.n_bonds)

    @property
    def bond_damping(self) -> Tensor:
        """Damping of every bond, (*batch, bond)."""
        return torch.as_tensor(self.damping).expand(*self.batch_shape, self.n_bonds)

    @property
    def is_damped(self) -> bool:
        return bool((torch.as_tensor(self.damping) > 0).any())

    @property
    def is_prestressed(self) -> bool:
        return bool((torch.as_tensor(self.tension) != 0).any())

    @property
    def cell(self) -> Tensor | None:
        """The periodic cell as rows (dimension, dimension); None unless periodic along every direction."""
        if self.box is None or not bool(self.box.isfinite().all()):
            return None
        return torch.diag(self.box) if self.box.ndim == 1 else self.box

    def nearest_image(self, vectors: Tensor) -> Tensor:
        """Vectors (*any, dimension) moved by periods of the box to be the shortest of all their copies."""
        if self.box is None:
            return vectors
        if self.box.ndim == 1:
            whole = torch.where(self.box.isfinite(), (vectors / self.box).round(), 0.0)
            return vectors - torch.where(whole == 0, 0.0, whole * self.box)
        vectors = vectors - (vectors @ torch.linalg.inv(self.box)).round() @ self.box
        best, size = vectors, vectors.square().sum(-1)
        for turns in np.ndindex(*(3,) * self.dimension):  # of a skewed cell, a neighbor's copy can be nearer
            moved = vectors + torch.tensor([t - 1.0 for t in turns]).to(self.box) @ self.box
            shorter = moved.square().sum(-1) < size * (1 - 1e-9)
            best = torch.where(shorter[..., None], moved, best)
            size = best.square().sum(-1)
        return best

    def align(self, values: Tensor, field: Tensor) -> Tensor:
        """``values`` (*batch, x) shaped to multiply a ``field`` (*batch, *any, x, component)."""
        batch = len(self.batch_shape)
        if field.shape[:batch] != self.batch_shape or field.ndim < batch + 2:
            raise checks.fail(
                "state",
                f"have leading axes {tuple(self.batch_shape)} like the network's masses",
                field,
            )
        middle = field.ndim - batch - 2
        return values.reshape(*values.shape[:-1], *[1] * (middle if values.ndim > 1 else 0), values.shape[-1], 1)

    def check_state(self, displacement: Tensor) -> None:
        """An error unless the last axes are particles and components of this network, the first its batch."""
        expected = (self.n_particles, self.n_components)
        if tuple(displacement.shape[-2:]) != expected:
            raise checks.fail(
                "state",
                f"have shape (*batch, {expected[0]}, {expected[1]}), particles and components of the network",
                displacement,
            )
        self.align(self.masses, displacement)

    def elongation(self, displacement: Tensor) -> Tensor:
        """u_j - u_i of every bond, (*batch, *any, bond, component); anchors rest."""
        if self.n_anchors:
            displacement = torch.nn.functional.pad(displacement, (0, 0, 0, self.n_anchors))
        return displacement.index_select(-2, self.bonds[:, 1]) - displacement.index_select(-2, self.bonds[:, 0])

    def net(self, bond_force: Tensor) -> Tensor:
        """Force on every particle from the pull of every bond on its first end, (*batch, *any, particle, component)."""
        shape = (*bond_force.shape[:-2], self.n_particles + self.n_anchors, bond_force.shape[-1])
        total = bond_force.new_zeros(shape)
        total = total.index_add(-2, self.bonds[:, 0], bond_force).index_add(-2, self.bonds[:, 1], -bond_force)
        return total[..., : self.n_particles, :]

    def bond_force(self, elongation: Tensor) -> Tensor:
        """C (u_j - u_i) of every bond, (*batch, *any, bond, component)."""
        stiffness = self.align(self.bond_stiffness, elongation)
        if self.motion == "scalar":
            return stiffness * elongation
        along = (elongation * self.directions).sum(-1, keepdim=True) * self.directions
        if not self.is_prestressed:
            return stiffness * along
        return stiffness * along + self.align(self.bond_tension / self.lengths, elongation) * (elongation - along)

    def force(self, displacement: Tensor) -> Tensor:
        """-K u, (*batch, *any, particle, component)."""
        return self.net(self.bond_force(self.elongation(displacement)))

    def damping_force(self, velocity: Tensor) -> Tensor:
        """Force of the bonds' dashpots, (*batch, *any, particle, component)."""
        rate = self.elongation(velocity)
        if self.motion == "vector":
            rate = (rate * self.directions).sum(-1, keepdim=True) * self.directions
        return self.net(self.align(self.bond_damping, rate) * rate)

    def bond_energy(self, displacement: Tensor) -> Tensor:
        """(u_j - u_i)^T C (u_j - u_i) / 2, (*batch, *any, bond); can be negative where a bond pushes."""
        elongation = self.elongation(displacement)
        return (self.bond_force(elongation) * elongation).sum(-1) / 2

    def kinetic_energy(self, velocity: Tensor) -> Tensor:
        """Of every particle, (*batch, *any, particle)."""
        return (self.align(self.masses, velocity) * velocity.square()).sum(-1) / 2

    def energy(self, displacement: Tensor, velocity: Tensor) -> Tensor:
        """Energy of the whole network relative to its state of rest, (*batch, *any)."""
        return self.kinetic_energy(velocity).sum(-1) + self.bond_energy(displacement).sum(-1)

    def bond_matrices(self) -> Tensor:
        """C of every bond, (*batch, bond, component, component)."""
        stiffness = self.bond_stiffness[..., None, None]
        if self.motion == "scalar":
            return stiffness
        along = self.directions[:, :, None] * self.directions[:, None, :]
        if not self.is_prestressed:
            return stiffness * along
        across = torch.eye(self.dimension).to(along) - along
        return stiffness * along + (self.bond_tension / self.lengths)[..., None, None] * across

    def stiffness_matrix(self) -> Tensor:
        """K, dense and symmetric, (*batch, unknown, unknown), unknowns in the order (particle, component)."""
        return self._dense(self.bond_matrices())

    def damping_matrix(self) -> Tensor:
        """The same of the dashpots."""
        damping = self.bond_damping[..., None, None]
        if self.motion == "vector":
            damping = damping * self.directions[:, :, None] * self.directions[:, None, :]
        return self._dense(damping)

    def _dense(self, blocks: Tensor) -> Tensor:
        n, c, all_points = self.n_particles, self.n_components, self.n_particles + self.n_anchors
        blocks = blocks.expand(*self.batch_shape, self.n_bonds, c, c).flatten(-2)
        i, j = self.bonds.unbind(-1)
        matrix = blocks.new_zeros(*self.batch_shape, all_points * all_points, c * c)
        for first, second, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            matrix = matrix.index_add(-2, first * all_points + second, sign * blocks)
        matrix = matrix.reshape(*self.batch_shape, all_points, all_points, c, c)[..., :n, :n, :, :]
        return matrix.transpose(-3, -2).reshape(*self.batch_shape, n * c, n * c)

    def sparse_stiffness(self, member: tuple[int, ...] = ()) -> scipy.sparse.csr_matrix:
        """K of one network of the batch as a SciPy matrix (unknown, unknown), for products and factorizations.

        Args:
            member: its index in the batch.
        """
        return next(self._sparse([member])).tocsr()

    def _sparse(self, members: Iterable[tuple[int, ...]]) -> Iterator[scipy.sparse.bsr_matrix]:
        """K of some networks of the batch in blocks of a particle's components, those of a pair as often as it has bonds."""
        n, c = self.n_particles, self.n_components
        first, second = self.bonds.cpu().unbind(-1)
        i, j = first.numpy(), second.numpy()
        bond, own = np.flatnonzero((i < n) & (j < n)), np.arange(n)
        rows = np.concatenate([own, i[bond], j[bond]])
        order = rows.argsort(kind="stable")
        columns = np.concatenate([own, j[bond], i[bond]])[order]
        which = np.concatenate([own, n + bond, n + bond])[order]
        starts = np.append(0, np.bincount(rows, minlength=n).cumsum())
        with torch.no_grad():
            every = self.bond_matrices().expand(*self.batch_shape, self.n_bonds, c, c)
        for member in members:
            blocks = every[member].double().cpu()
            ends = blocks.new_zeros(n + self.n_anchors, c, c).index_add(0, first, blocks).index_add(0, second, blocks)
            data = torch.cat([ends[:n], -blocks]).numpy()[which]
            yield scipy.sparse.bsr_matrix((data, columns, starts), shape=(n * c, n * c))

    def squared_frequency_bound(self, sweeps: int = SWEEPS) -> Tensor:
        """A rigorous upper bound on every |w^2|, (*batch,), float64.

        No eigenvalue of M^-1 K exceeds the largest of (|M^-1 K| x) / x over the unknowns, for any positive x (Collatz
        and Wielandt; Gershgorin's is x = 1). Some power steps make x a good one, and two ulps cover the rounding.
        """
        masses = self.masses.detach().double()
        flat = masses.cpu().reshape(-1, self.n_particles).repeat_interleave(self.n_components, 1).numpy()
        largest = []
        for matrix, mass in zip(self._sparse(np.ndindex(*self.batch_shape)), flat, strict=True):
            np.abs(matrix.data, out=matrix.data)
            x = np.ones_like(mass)
            for _ in range(sweeps + 1):
                ratio = matrix @ x / mass / x
                # The geometric mean of x and its image does not alternate; a rattler, which no bond holds, keeps its x.
                x = x * np.sqrt(ratio)
                x = np.maximum(x / max(x.max(), 1e-300), 1e-60)
            largest.append(ratio.max() * (1 + 1e-14))
        found = torch.tensor(largest, dtype=torch.float64, device=masses.device).reshape(self.batch_shape)
        return torch.minimum(found, self._other_bound(masses[..., None]))

    def _other_bound(self, masses: Tensor) -> Tensor:
        """A second bound (*batch,), where a special kind of network knows one; infinite here."""
        return torch.full(self.batch_shape, torch.inf, dtype=torch.float64, device=masses.device)

    def with_bonds(self, keep: Tensor) -> Network:
        """The network without the bonds where ``keep`` (bond,) is False."""
        return replace(self, **self._kept(keep))

    def _kept(self, keep: Tensor) -> dict[str, Any]:
        """The fields that hold one entry per bond, for the bonds to keep."""
        keep = torch.as_tensor(keep, device=self.bonds.device)
        if keep.dtype != torch.bool or tuple(keep.shape) != (self.n_bonds,):
            raise checks.fail(
                "keep", f"be truth values of shape ({self.n_bonds},)", f"{keep.dtype}, shape {tuple(keep.shape)}"
            )
        fields: dict[str, Any] = {"bonds": self.bonds[keep]}
        if self.images is not None:
            fields["images"] = self.images[keep]
        for name in ("stiffness", "tension", "damping"):
            fields[name] = torch.as_tensor(getattr(self, name))[..., keep]
        return fields
