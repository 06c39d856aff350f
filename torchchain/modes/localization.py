"""Localization of modes and the density of states of disordered chains, without eigenvectors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.disorder import Disorder
from torchchain.threads import single_thread


@dataclass(frozen=True, eq=False)
class Estimate:
    """A value and its standard error over realizations, each (frequency,)."""

    value: Tensor
    stderr: Tensor


def lyapunov_exponent(
    disorder: Disorder,
    frequencies: Any,
    n_particles: int = 10_000,
    realizations: int = 50,
    seed: int = 0,
    stiffness_disorder: Disorder | None = None,
) -> Estimate:
    """Lyapunov exponent gamma(w): waves of frequency w decay as exp(-gamma n) along a disordered chain.

    The displacement u and tension T obey the transfer recursion T' = T - b w^2 u, u' = u + T' / kappa; gamma is its mean
    logarithmic growth per particle (the pair is rescaled at every step). 1 / gamma is the localization length of a
    mode's amplitude.

    Args:
        disorder: of the masses.
        frequencies: w, (frequency,), in units where the ordered chain's band ends at 2.
        n_particles: length of each chain; the bias of the start falls as 1 / n_particles.
        realizations: chains to average, at least 2.
        seed: see :class:`Disorder`.
        stiffness_disorder: of the contacts; None for equal contacts.

    Returns:
        Estimate with gamma per particle.

    Example:
        >>> found = tc.localization.lyapunov_exponent(tc.Disorder(strength=0.1), [1.0], n_particles=1000, realizations=20)
        >>> abs(found.value / tc.localization.weak_disorder_lyapunov(0.1, [1.0]) - 1).item() < 0.3
        True
    """
    checks.instance("disorder", disorder, Disorder)
    checks.instance("stiffness_disorder", stiffness_disorder, Disorder, type(None))
    w = checked_frequencies(frequencies).to(torch.float64)
    checks.first_bad("frequencies", "be at most 1e100", w, w > 1e100)
    realizations = checks.integer("realizations", realizations, 2)
    masses = disorder.masses(n_particles, realizations, seed)
    softness = torch.ones_like(masses)
    if stiffness_disorder is not None:
        softness = 1 / stiffness_disorder.stiffnesses(n_particles, realizations, seed)
    squared = w.square()
    displacement = torch.ones(realizations, len(w), dtype=torch.float64)
    tension = torch.zeros_like(displacement)
    growth = torch.zeros_like(displacement)
    with single_thread():
        for mass, soft in zip(masses.T.contiguous(), softness.T.contiguous(), strict=True):
            tension = tension - mass[:, None] * squared * displacement
            displacement = displacement + soft[:, None] * tension
            size = torch.hypot(displacement, tension)
            growth += size.log()
            displacement, tension = displacement / size, tension / size
    rate = growth / n_particles
    return Estimate(rate.mean(0), rate.std(0) / realizations**0.5)


def weak_disorder_lyapunov(strength: float, frequencies: Any) -> Tensor:
    """gamma = xi^2 w^2 / (8 (1 - w^2 / 4)) for weak mass disorder (Matsuda and Ishii 1970), (frequency,), 0 <= w < 2.

    Args:
        strength: xi, small against 1.
        frequencies: w, (frequency,).

    Example:
        >>> tc.localization.weak_disorder_lyapunov(0.1, [1.0]).item()
        0.001666666666666667
    """
    strength = checks.number("strength", strength, at_least=0, at_most=1e100)
    w = checks.real_tensor("frequencies", frequencies)
    checks.first_bad("frequencies", "lie in [0, 2)", w, (w < 0) | (w >= 2))
    return strength**2 * w.square() / (8 * (1 - w.square() / 4))


def count_modes_below(chain: Chain, frequencies: Any) -> Tensor:
    """Number of modes with a frequency below each given one, by Sturm sequences: N steps, no eigenvalues.

    The number of negative pivots in the elimination of -K - w^2 M is the number of its negative eigenvalues
    (Sylvester's law of inertia). A ring is eliminated with its closing column kept beside the diagonal.

    Args:
        chain: masses (*batch, particle); Hertz contacts are taken at the initial overlap.
        frequencies: w >= 0, (frequency,).

    Returns:
        (*batch, frequency), int64.

    Example:
        >>> tc.localization.count_modes_below(tc.Chain(torch.ones(100)), [0.5, 1.0, 3.0]).tolist()
        [17, 34, 100]
    """
    checks.instance("chain", chain, Chain)
    w = checked_frequencies(frequencies).to(chain.masses)
    return negative_pivots(chain, w.square().expand(*chain.batch_shape, len(w)))


def checked_frequencies(frequencies: Any) -> Tensor:
    """Frequencies w >= 0, (frequency,)."""
    w = checks.real_tensor("frequencies", frequencies)
    checks.first_bad("frequencies", "not be negative", w, w < 0)
    if w.ndim != 1:
        raise checks.fail("frequencies", "be one-dimensional", w)
    return w


def negative_pivots(chain: Chain, squared: Tensor) -> Tensor:
    """Eigenvalues of -M^-1 K below each squared frequency (*batch, frequency) of its own chain, (*batch, frequency), int64."""
    stiffness, n, ring = chain.contact_stiffness, chain.n_particles, chain.is_free
    tiny = torch.finfo(chain.masses.dtype).tiny ** 0.5
    diagonal = chain.of_both_contacts(stiffness)[..., None] - chain.masses[..., None] * squared[..., None, :]
    count = torch.zeros(squared.shape, dtype=torch.int64, device=squared.device)
    pivot = diagonal[..., 0, :]
    closing = -stiffness[..., 0, None].expand_as(pivot)  # coupling of the current particle to the last one of a ring
    last = diagonal[..., n - 1, :].clone()
    for i in range(1, n + 1):
        pivot = torch.where(pivot == 0, torch.full_like(pivot, -tiny), pivot)
        count += pivot < 0
        if i == n:
            break
        coupling = -stiffness[..., i, None]
        if ring and i == n - 1:
            closing = closing + coupling
            pivot = last - closing.square() / pivot
        else:
            if ring:
                last = last - closing.square() / pivot
                closing = -closing * coupling / pivot
            pivot = diagonal[..., i, :] - coupling.square() / pivot
    return count


def integrated_density_of_states(
    disorder: Disorder, frequencies: Any, n_particles: int = 4096, realizations: int = 20, seed: int = 0
) -> Estimate:
    """Share of the modes below each frequency in long disordered chains; w / pi for w -> 0 (Dyson 1953).

    Args:
        disorder: of the masses.
        frequencies: (frequency,).
        n_particles, realizations, seed: the fixed chains that are counted.

    Example:
        >>> found = tc.localization.integrated_density_of_states(tc.Disorder(strength=0.1), [0.1, 1.0], n_particles=256)
        >>> [round(value, 2) for value in found.value.tolist()]
        [0.03, 0.33]
    """
    checks.instance("disorder", disorder, Disorder)
    realizations = checks.integer("realizations", realizations, 2)
    checks.integer("n_particles", n_particles, 2)
    chain = Chain(disorder.masses(n_particles, realizations, seed), boundary="fixed")
    with single_thread():
        share = count_modes_below(chain, frequencies).to(torch.float64) / n_particles
    return Estimate(share.mean(0), share.std(0) / realizations**0.5)
