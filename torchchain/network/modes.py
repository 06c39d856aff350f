"""Normal modes of networks by batched eigen-decomposition; zero modes; stability."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain import checks
from torchchain.network.networks import Network
from torchchain.network.packings import rattlers

MOST_UNKNOWNS = 20_000  # of a dense decomposition
MOST_DENSE = 1500  # unknowns up to which stability is looked up in all eigenvalues
MOST_FACTORED = 10**6  # unknowns up to which it is looked up in a sparse factorization


class FloppyWarning(UserWarning):
    """A network with more zero modes than its rigid motions.

    Example:
        >>> tc.network.softness(tc.lattice("square", (4, 4))).zero_modes  # what the warning of its modes counts
        8
    """


class UnstableError(checks.FieldError):
    """A network whose prestress makes a squared frequency negative.

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], dtype=torch.float64)
        >>> pressed = tc.Network(torch.ones(3), x, [[0, 1], [1, 2]], tension=-0.5)  # a free row under pressure buckles
        >>> try:
        ...     tc.network.check_stability(pressed)
        ... except tc.network.UnstableError as error:
        ...     print(type(error).__name__)
        UnstableError
    """


@dataclass(frozen=True, eq=False)
class NetworkModes:
    """Normal modes of a network.

    Attributes:
        frequencies: (*batch, mode), ascending; exactly zero for zero modes.
        shapes: (*batch, particle, component, mode), with unit modal mass: sum of m |s|^2 over the particles is 1.

    Example:
        >>> modes = tc.normal_modes(tc.lattice("triangular", (4, 4)))
        >>> tuple(modes.shapes.shape), int(modes.n_zero)
        ((16, 2, 32), 2)
    """

    frequencies: Tensor
    shapes: Tensor

    @property
    def n_zero(self) -> Tensor:
        """Zero modes of each network, (*batch,)."""
        return (self.frequencies == 0).sum(-1)


@dataclass(frozen=True)
class Softness:
    """Why a network has zero modes.

    Attributes:
        zero_modes: all of them.
        rigid: motions of the whole that no bond feels: translations, and rotations of what is free to turn.
        components: pieces not connected by bonds.
        rattlers: loose particles; see :func:`torchchain.network.rattlers`.

    Example:
        >>> tc.network.softness(tc.lattice("triangular", (4, 4))).floppy
        0
    """

    zero_modes: int
    rigid: int
    components: int
    rattlers: int

    @property
    def floppy(self) -> int:
        return self.zero_modes - self.rigid

    def __str__(self) -> str:
        return (
            f"{self.zero_modes} zero modes, {self.rigid} of them rigid motions of the whole; "
            f"{self.components} connected {'piece' if self.components == 1 else 'pieces'}, {self.rattlers} rattlers"
        )


def normal_modes(network: Network) -> NetworkModes:
    """Normal modes of a network (or of a packing about its state); see :func:`torchchain.normal_modes`.

    Decomposes M^-1/2 K M^-1/2, all networks of a batch at once, and takes each w^2 anew from the mode's bonds, sum of
    e . C e, which is accurate relative to w itself where the solver's is accurate only relative to the largest.
    """
    checks.instance("network", network, Network)
    n, c = network.n_particles, network.n_components
    if network.is_damped:
        raise checks.fail("damping", "be zero for normal modes (use evolve's method 'damped')", "more")
    if n * c > MOST_UNKNOWNS:
        raise checks.fail(
            "network",
            f"have at most {MOST_UNKNOWNS} unknowns for all modes (use method 'chebyshev' or spectral moments)",
            n * c,
        )
    weight = network.masses.rsqrt().repeat_interleave(c, dim=-1)
    squared, vectors = torch.linalg.eigh(network.stiffness_matrix() * weight[..., :, None] * weight[..., None, :])
    shapes = (vectors * weight[..., :, None]).unflatten(-2, (n, c))
    fields = shapes.movedim(-1, -3)  # (*batch, mode, particle, component)
    elongation = network.elongation(fields)
    refined = (network.bond_force(elongation) * elongation).sum((-2, -1))
    eps = torch.finfo(squared.dtype).eps
    limit = 4 * n * c * eps * squared.detach().abs().amax(-1, keepdim=True)
    where = checks.first(((refined - squared).detach().abs() > limit).any(-1))
    if where is not None:
        raise RuntimeError(f"the eigen-solver's modes must satisfy their equation, got others{checks.position(where)}")
    lowest = refined.detach().amin(-1)
    where = checks.first(lowest < -limit[..., 0])
    if where is not None:
        raise _unstable(lowest[where].item(), int((refined[where] < -limit[where]).sum()), where)
    zero = refined.detach() <= limit
    refined = torch.where(zero, 1.0, refined).sqrt()
    frequencies = torch.where(zero, 0.0, refined)
    frequencies, order = frequencies.sort(dim=-1)
    shapes = shapes.gather(-1, order[..., None, None, :].expand(shapes.shape))
    modes = NetworkModes(frequencies, shapes)
    zero_modes = int(modes.n_zero.max())
    if zero_modes > rigid_motions(network):
        warnings.warn(f"the network has {describe_softness(network, zero_modes)}", FloppyWarning, stacklevel=3)
    return modes


def _unstable(squared: float, count: int | None, where: tuple[int, ...] = ()) -> UnstableError:
    several = "" if count is None else f", one of {count} below zero" if count > 1 else ""
    return UnstableError(
        f"tension must leave every squared frequency positive or zero, got {squared:.6g}{several}{checks.position(where)}"
    )


def softness(network: Network) -> Softness:
    """Zero modes of a network and where they come from; for a batch, of the softest member.

    >>> from torchchain.network import lattice
    >>> print(softness(lattice("square", (4, 4))))
    8 zero modes, 2 of them rigid motions of the whole; 1 connected piece, 0 rattlers
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FloppyWarning)
        zero_modes = int(normal_modes(network).n_zero.max())
    return describe_softness(network, zero_modes)


def describe_softness(network: Network, zero_modes: int) -> Softness:
    """The record for a number of zero modes that is known."""
    loose = int(rattlers(network).sum())
    return Softness(zero_modes, rigid_motions(network), len(set(components(network).tolist())), loose)


def components(network: Network) -> Tensor:
    """Number of the connected piece that each particle belongs to, counted from 0, (particle,); anchors are one body.

    Example:
        >>> x = torch.tensor([[0.0], [1.0], [5.0], [6.0]], dtype=torch.float64)
        >>> tc.network.components(tc.Network(torch.ones(4), x, [[0, 1], [2, 3]])).tolist()
        [0, 0, 1, 1]
    """
    n = network.n_particles
    bonds = network.bonds.cpu().numpy()
    held = (torch.as_tensor(network.stiffness).detach() > 0).reshape(-1, network.n_bonds).any(0).cpu().numpy()
    i, j = np.minimum(bonds, n).T[:, held] if len(bonds) else np.zeros((2, 0), np.int64)
    graph = scipy.sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(n + 1, n + 1))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    _, label = np.unique(label[:n], return_inverse=True)
    return torch.from_numpy(label.reshape(-1)).to(network.bonds.device)


def rigid_motions(network: Network) -> int:
    """How many independent motions of the whole network change no bond: 0 if it is anchored.

    Translations, and rotations in the planes of two directions that are not periodic.

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.8]], dtype=torch.float64)
        >>> tc.network.rigid_motions(tc.Network(torch.ones(3), x, [[0, 1], [1, 2], [2, 0]]))  # two shifts and a turn
        3
    """
    if network.n_anchors:
        return 0
    if network.motion == "scalar":
        return 1
    d, n = network.dimension, network.n_particles
    box = network.box
    # A skewed cell couples its axes: nothing turns.
    is_open = [True] * d if box is None else [box.ndim == 1 and not bool(b) for b in box.isfinite().reshape(-1)[:d]]
    x = network.positions.detach().double().cpu().numpy()
    x = x - x.mean(0)
    size = np.abs(x).max() or 1.0
    motions = []
    for a, b in combinations([a for a in range(d) if is_open[a]], 2):
        turn = np.zeros((n, d))
        turn[:, a], turn[:, b] = x[:, b] / size, -x[:, a] / size
        motions.append(turn.reshape(-1))
    return d + (int(np.linalg.matrix_rank(np.stack(motions), tol=1e-9 * n**0.5)) if motions else 0)


def check_stability(network: Network) -> None:
    """An error that names the lowest squared frequency where pushing bonds make it negative.

    Only bonds with negative tension can. Small networks are decomposed, larger ones factored sparsely, whose negative
    pivots count the negative eigenvalues (Sylvester's law of inertia).

    Raises:
        UnstableError: if a squared frequency lies below -1e-10 of the largest possible.

    Example:
        >>> tc.network.check_stability(tc.lattice("triangular", (4, 4)))
    """
    if network.motion == "scalar" or not bool((torch.as_tensor(network.tension).detach() < 0).any()):
        return
    bounds = network.squared_frequency_bound()
    for member in np.ndindex(*network.batch_shape):
        matrix = network.sparse_stiffness(member)
        masses = network.masses.detach()[member].double().cpu().numpy().repeat(network.n_components)
        weight = scipy.sparse.diags(masses**-0.5)
        matrix = (weight @ matrix @ weight).tocsc()
        slack = 1e-10 * float(bounds[member])
        if len(masses) <= MOST_DENSE:
            values = np.linalg.eigvalsh(matrix.toarray())
            if values[0] < -slack:
                raise _unstable(float(values[0]), int((values < -slack).sum()), member)
            continue
        if len(masses) > MOST_FACTORED:
            continue
        negative = _negative_pivots(matrix + slack * scipy.sparse.identity(len(masses), format="csc"))
        if negative:
            lowest = scipy.sparse.linalg.eigsh(
                matrix, k=1, which="SA", return_eigenvectors=False, tol=1e-3, v0=np.cos(np.arange(1.0, 1 + len(masses)))
            )
            raise _unstable(float(lowest[0]), negative, member)


def exceeds(network: Network, squared: float, member: tuple[int, ...] = ()) -> bool:
    """Whether a squared frequency of one network of the batch exceeds a number by more than rounding.

    None does exactly where the number times M, less K, has no negative eigenvalue.
    """
    masses = network.masses.detach()[member].double().cpu().numpy().repeat(network.n_components)
    matrix = squared * (1 + 1e-10) * scipy.sparse.diags(masses) - network.sparse_stiffness(member)
    return _negative_pivots(matrix.tocsc()) > 0


def _negative_pivots(matrix: scipy.sparse.csr_matrix) -> int:
    """Negative eigenvalues of a symmetric matrix, by elimination without exchange of rows."""
    factors = scipy.sparse.linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return int((factors.U.diagonal() < 0).sum())
