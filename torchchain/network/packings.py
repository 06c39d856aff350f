"""Packings of disks and spheres: contacts from overlaps, with their prestress; rattlers."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain import checks
from torchchain.network.networks import Network

CONTACTS = ("linear", "hertz")
MOST_IMAGES = 10**7  # particles and copies in a search for contacts


@dataclass(frozen=True, eq=False)
class Packing(Network):
    """A :class:`Network` of grains in contact, linear about the state it was made from; made by :func:`packing`.

    Two grains whose centers are closer than the sum of their radii, by the overlap delta, repel each other with

        kappa delta                (contact "linear"),
        (2/3) kappa delta^(3/2)    (contact "hertz": its slope is kappa at overlap 1, as in a chain).

    ``stiffness`` and ``tension`` hold the slope and minus the force of each contact at its overlap.

    Attributes:
        radii: (particle,).
        contact: "linear" or "hertz".
        modulus: kappa, one number for all contacts.

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [0.9, 0.0]], dtype=torch.float64)
        >>> pair = tc.packing(x, radii=torch.full((2,), 0.5), masses=torch.ones(2), contact="hertz")
        >>> pair.overlaps.round(decimals=3).tolist()
        [0.1]
    """

    radii: Tensor = field(default_factory=lambda: torch.zeros(0), kw_only=True)
    contact: str = field(default="linear", kw_only=True)
    modulus: float = field(default=1.0, kw_only=True)

    @property
    def overlaps(self) -> Tensor:
        """Overlap of every contact, (contact,)."""
        return self.radii[self.bonds].sum(-1) - self.lengths

    @property
    def n_contacts(self) -> int:
        return self.n_bonds


def packing(
    positions: Any,
    radii: Any,
    masses: Any,
    box: Any = None,
    stiffness: float = 1.0,
    contact: str = "linear",
    damping: float = 0.0,
    prestress: bool = True,
) -> Packing:
    """The network of the contacts of overlapping disks or spheres.

    >>> import torch
    >>> x = torch.tensor([[0.0, 0.0], [0.9, 0.0], [0.0, 0.9], [0.9, 0.9]], dtype=torch.float64)
    >>> made = packing(x, torch.full((4,), 0.5), torch.ones(4), box=torch.tensor([1.8, 1.8]))
    >>> made.n_contacts  # each grain touches both copies of two others
    8

    Args:
        positions: centers (particle, dimension), two or three dimensions, or one.
        radii: (particle,), positive.
        masses: (*batch, particle).
        box: periods (dimension,), infinite where not periodic; rows (dimension, dimension) for a skewed cell; or None.
        stiffness: kappa of :class:`Packing`.
        contact: "linear" or "hertz".
        damping: of every contact's change of length, force per velocity.
        prestress: False leaves out the contact forces ("unstressed" network), which take from the stiffness across.

    Returns:
        Packing; grains without contacts stay in it (see :func:`rattlers` and :func:`without_rattlers`).

    Raises:
        FieldError: for values out of range, and for two centers at one place.
    """
    positions = checks.real_tensor("positions", positions)
    masses = checks.real_tensor("masses", masses).to(positions)
    radii = checks.real_tensor("radii", radii).to(positions)
    checks.choice("contact", contact, CONTACTS)
    modulus = checks.number("stiffness", stiffness, above=0)
    checks.truth("prestress", prestress)
    bare = Network(masses, positions, torch.zeros((0, 2), dtype=torch.int64), box=box)  # checks all but the radii
    if tuple(radii.shape) != (bare.n_particles,):
        raise checks.fail("radii", f"have shape ({bare.n_particles},) like the particles", radii)
    checks.first_bad("radii", "be positive", radii, radii <= 0, "particle")
    bonds, images = near_pairs(positions, radii, bare.box)
    made = Packing(
        masses, positions, bonds, box=bare.box, images=images if bare.box is not None else None, damping=damping,
        radii=radii, contact=contact, modulus=modulus,
    )  # fmt: skip
    force, slope = contact_law(made.overlaps, contact, modulus)
    return replace(made, stiffness=slope, tension=-force if prestress else 0.0)


def contact_law(overlap: Tensor, contact: str, modulus: float) -> tuple[Tensor, Tensor]:
    """Force and its slope for overlaps, zero for open contacts."""
    overlap = overlap.clamp(min=0)
    if contact == "linear":
        return modulus * overlap, modulus * (overlap > 0).to(overlap)
    root = overlap.sqrt()
    return 2 / 3 * modulus * overlap * root, modulus * root


def near_pairs(positions: Tensor, radii: Tensor, box: Tensor | None, skin: float = 0.0) -> tuple[Tensor, Tensor]:
    """Pairs of grains, copies across the box included, with a gap below ``skin``: bonds (pair, 2), images (pair, dimension)."""
    x, r = positions.detach().double().cpu().numpy(), radii.detach().double().cpu().numpy()
    n, d = x.shape
    farthest = 2 * r.max() + skin
    shift = np.zeros((n, d), np.int64)  # of a center into the cell
    copies, of, moved = x, np.arange(n), np.zeros((n, d), np.int64)
    if box is not None:
        cell = box.detach().double().cpu().numpy()
        periodic = np.isfinite(cell) if cell.ndim == 1 else np.ones(d, bool)
        cell = np.diag(np.where(periodic, cell, 1.0)) if cell.ndim == 1 else cell
        inverse = np.linalg.inv(cell)
        fraction = x @ inverse
        shift = np.where(periodic, -np.floor(fraction), 0).astype(np.int64)
        x = x + shift @ cell
        fraction = x @ inverse
        width = 1 / np.linalg.norm(inverse, axis=0)
        copies = x
        for a in np.flatnonzero(periodic):
            depth = int(np.ceil(farthest / width[a]))
            parts = [(copies, of, moved)]
            for turn in [*range(-depth, 0), *range(1, depth + 1)]:
                place = fraction[of, a] + turn
                near = (place > -farthest / width[a]) & (place < 1 + farthest / width[a])
                add = np.zeros(d, np.int64)
                add[a] = turn
                parts.append((copies[near] + add @ cell, of[near], moved[near] + add))
            copies, of, moved = (np.concatenate(kind) for kind in zip(*parts, strict=True))
            if len(copies) > MOST_IMAGES:
                raise checks.fail("radii", "be smaller than the box by more", f"{len(copies)} copies within reach")
    tree = scipy.spatial.cKDTree(copies)
    pairs = tree.query_pairs(farthest, output_type="ndarray") if len(copies) > 1 else np.zeros((0, 2), np.int64)
    pairs = pairs[pairs[:, 0] < n]  # the lower of the two is in the cell, whose centers come first
    gap = np.linalg.norm(copies[pairs[:, 1]] - copies[pairs[:, 0]], axis=1) - r[of[pairs[:, 0]]] - r[of[pairs[:, 1]]]
    pairs = pairs[gap < skin]
    first, second, image = of[pairs[:, 0]], of[pairs[:, 1]], moved[pairs[:, 1]]
    # A pair across the boundary is found from both sides: keep the one with the lower number first, or for a grain and
    # its own copy the one whose first image is positive.
    outside = (image != 0).any(1)
    lead = np.sign(image[np.arange(len(image)), (image != 0).argmax(1)]) if len(image) else np.zeros(0)
    keep = ~outside | (first < second) | ((first == second) & (lead > 0))
    first, second, image = first[keep], second[keep], image[keep]
    turned = first > second
    image[turned] *= -1
    first, second = np.where(turned, second, first), np.where(turned, first, second)
    image = image + shift[second] - shift[first]  # between the centers as given
    order = np.lexsort((*image.T, second, first))
    bonds = np.stack([first, second], axis=1)[order]
    return torch.from_numpy(bonds).to(positions.device), torch.from_numpy(image[order]).to(positions.device)


def rattlers(network: Network) -> Tensor:
    """Which particles are loose, (particle,): those with too few bonds to others that are not, found recursively.

    A grain needs dimension + 1 contacts, at least, to be held by pushes alone; a particle of another network, whose
    bonds also pull, needs as many as dimensions, and one bond for motion "scalar".

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.8], [5.0, 5.0]], dtype=torch.float64)
        >>> tc.network.rattlers(tc.Network(torch.ones(4), x, [[0, 1], [1, 2], [2, 0]])).tolist()
        [False, False, False, True]
    """
    n = network.n_particles
    need = network.n_components + (isinstance(network, Packing) and network.motion == "vector")
    bonds = network.bonds.cpu().numpy()
    held = np.asarray((torch.as_tensor(network.stiffness).detach() > 0).reshape(-1, network.n_bonds).any(0).cpu())
    loose = np.zeros(n + network.n_anchors, bool)
    while True:
        alive = held & ~loose[bonds].any(1)
        count = np.bincount(bonds[alive].reshape(-1), minlength=n + network.n_anchors)
        found = ~loose & (count < need)
        found[n:] = False
        if not found.any():
            return torch.from_numpy(loose[:n]).to(network.bonds.device)
        loose |= found


def without_rattlers(network: Network) -> Network:
    """The network of the other particles and the bonds between them, renumbered in order.

    Example:
        >>> x = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.8], [5.0, 5.0]], dtype=torch.float64)
        >>> tc.network.without_rattlers(tc.Network(torch.ones(4), x, [[0, 1], [1, 2], [2, 0]])).n_particles
        3
    """
    keep = ~rattlers(network)
    return subnetwork(network, keep)


def subnetwork(network: Network, keep: Tensor) -> Network:
    """The network of the particles where ``keep`` (particle,) holds, renumbered in order; anchors stay.

    Example:
        >>> sheet = tc.lattice("square", (4, 4))
        >>> tc.network.subnetwork(sheet, torch.arange(16) < 8).n_particles
        8
    """
    n, device = network.n_particles, network.bonds.device
    if keep.dtype != torch.bool or tuple(keep.shape) != (n,):
        raise checks.fail("keep", f"be truth values of shape ({n},)", f"{keep.dtype}, shape {tuple(keep.shape)}")
    all_keep = torch.cat([keep, torch.ones(network.n_anchors, dtype=torch.bool, device=device)])
    number = all_keep.cumsum(0) - 1
    kept: Any = network.with_bonds(all_keep[network.bonds].all(-1))
    fields: dict[str, Any] = {
        "masses": network.masses[..., keep],
        "positions": network.positions[keep],
        "bonds": number[kept.bonds],
    }
    if isinstance(network, Packing):
        return replace(kept, **fields, radii=network.radii[keep])
    # Of a lattice what is left is none.
    return Network(
        **{each.name: getattr(kept, each.name) for each in dataclasses.fields(Network) if each.init} | fields
    )
