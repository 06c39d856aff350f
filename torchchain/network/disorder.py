"""Disorder of networks: masses, stiffness, missing bonds, moved particles, mixtures; realization i of a seed is always the same."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from scipy import special
from torch import Tensor

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.chain.disorder import numbers_of, uniform
from torchchain.network.networks import Network

AnyNetwork = TypeVar("AnyNetwork", bound=Network)
_BONDS, _POSITIONS, _KINDS = 2, 3, 4  # random streams of a realization, besides those of masses and stiffnesses


def disordered(
    network: Network,
    masses: Disorder | None = None,
    stiffness: Disorder | None = None,
    realizations: int | Iterable[int] = 1,
    seed: int = 0,
) -> Network:
    """The network with random factors on its masses and stiffnesses, one network for each realization.

    >>> from torchchain.chain import Disorder
    >>> from torchchain.network import lattice
    >>> disordered(lattice("square", (4, 4)), masses=Disorder(strength=0.2), realizations=3).masses.shape
    torch.Size([3, 16])

    Args:
        network: without batch axes.
        masses, stiffness: what the factors are drawn from; None leaves them.
        realizations: how many, or their numbers, counted from 0.
        seed: 0 to 2**64 - 1.

    Returns:
        The same kind of network with masses (realization, particle) and stiffness (realization, bond).
    """
    _one(network)
    numbers = numbers_of(realizations)
    changes: dict[str, Any] = {"masses": network.masses.expand(len(numbers), -1)}
    if masses is not None:
        checks.instance("masses", masses, Disorder)
        changes["masses"] = network.masses * masses.masses(network.n_particles, numbers, seed).to(network.masses)
    if stiffness is not None and network.n_bonds:
        checks.instance("stiffness", stiffness, Disorder)
        factor = stiffness.stiffnesses(network.n_bonds, numbers, seed).to(network.masses)
        changes["stiffness"] = network.bond_stiffness * factor
    return replace(network, **changes)


def diluted(network: Network, fraction: float, realizations: int | Iterable[int] = 1, seed: int = 0) -> Network:
    """The network with each bond removed with a probability: stiffness and tension 0, one network for each realization.

    Args:
        network: without batch axes.
        fraction: the probability, 0 to 1.
        realizations, seed: as for :func:`disordered`.

    Example:
        >>> thinned = tc.network.diluted(tc.lattice("triangular", (10, 10)), fraction=0.2, realizations=3, seed=0)
        >>> tuple(thinned.stiffness.shape)
        (3, 300)
    """
    _one(network)
    fraction = checks.number("fraction", fraction, at_least=0, at_most=1)
    numbers = numbers_of(realizations)
    one_each = replace(network, masses=network.masses.expand(len(numbers), -1))
    return without_bonds(one_each, kept_bonds(network.n_bonds, fraction, numbers, seed))


def without_bonds(network: AnyNetwork, kept: Tensor) -> AnyNetwork:
    """Networks without stiffness, tension and damping where ``kept``, of :func:`kept_bonds`, is 0."""
    kept = kept.to(network.masses)
    changes: dict[str, Any] = {"stiffness": network.bond_stiffness * kept}
    if network.is_prestressed:
        changes["tension"] = network.bond_tension * kept
    if network.is_damped:
        changes["damping"] = network.bond_damping * kept
    return replace(network, **changes)


def kept_bonds(n_bonds: int, fraction: float, realizations: Iterable[int], seed: int) -> Tensor:
    """1 for a bond that stays, 0 for one removed with this probability, (realization, bond)."""
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    kept = [uniform(n_bonds, i, seed, _BONDS) >= fraction for i in realizations]
    return torch.from_numpy(np.stack(kept)).double()


def displaced(network: AnyNetwork, strength: float, realization: int = 0, seed: int = 0) -> AnyNetwork:
    """The network with its particles moved by independent normal steps, its bonds at rest at their new lengths.

    Args:
        network: any.
        strength: standard deviation of the step along each direction, in the unit of the positions.
        realization, seed: one realization, as positions have no batch axes.

    Example:
        >>> moved = tc.network.displaced(tc.lattice("triangular", (6, 6)), strength=0.02, seed=0)
        >>> tuple(moved.positions.shape)
        (36, 2)
    """
    strength = checks.number("strength", strength, at_least=0)
    realization = checks.integer("realization", realization, 0, 2**63)
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    steps = special.ndtri(uniform(network.positions.numel(), realization, seed, _POSITIONS))
    moved = network.positions + strength * torch.from_numpy(steps).to(network.positions).reshape(
        network.positions.shape
    )
    return replace(network, positions=moved)


def mixture(
    n_particles: int,
    values: Sequence[float],
    fractions: Sequence[float],
    realizations: int | Iterable[int] = 1,
    seed: int = 0,
) -> Tensor:
    """A mixture of some values in exact numbers and random order, (realization, particle): masses, or radii of a packing.

    >>> mixture(5, (1.0, 1.4), (0.6, 0.4)).sort().values
    tensor([[1.0000, 1.0000, 1.0000, 1.4000, 1.4000]], dtype=torch.float64)

    Args:
        n_particles: how many.
        values: of the kinds.
        fractions: of the kinds, adding up to 1; the numbers are rounded so that they add up.
        realizations, seed: as for :func:`disordered`.
    """
    n_particles = checks.integer("n_particles", n_particles, 1, 10**8)
    kinds = checks.real_tensor("values", values).double().numpy()
    parts = checks.real_tensor("fractions", fractions).double().numpy()
    if kinds.shape != parts.shape or kinds.ndim != 1 or parts.min() < 0 or abs(parts.sum() - 1) > 1e-9:
        raise checks.fail("fractions", "be one for each value, not negative, and add up to 1", parts.tolist())
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    ends = np.round(np.cumsum(parts) * n_particles).astype(int)
    ends[-1] = n_particles
    ordered = np.repeat(kinds, np.diff(np.concatenate([[0], ends])))
    rows = [ordered[np.argsort(uniform(n_particles, i, seed, _KINDS), kind="stable")] for i in numbers_of(realizations)]
    return torch.from_numpy(np.stack(rows))


def _one(network: Network) -> None:
    checks.instance("network", network, Network)
    if network.batch_shape:
        raise checks.fail(
            "network", "be one network, without batch axes, to draw disorder for", tuple(network.batch_shape)
        )
