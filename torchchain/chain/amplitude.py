"""How far a motion is from the small amplitudes for which contacts are linear (Eqs. 9-12)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory

DEVIATION_WHERE_OPEN = 1 / 3
"""|F / F_linear - 1| of a Hertz contact that is just open."""


class LinearityWarning(UserWarning):
    """Linear contacts asked for amplitudes at which real ones are markedly nonlinear, or open.

    Example:
        >>> import warnings
        >>> scene = tc.Scene(n_particles=16, n_bands=4, excitation=tc.StandingWave(tones=(4,), amplitude=0.3), realizations=2, times=[1.0])
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     _ = tc.simulate(scene, method="modes")
        >>> any(issubclass(warning.category, tc.LinearityWarning) for warning in told)
        True
    """


@dataclass(frozen=True, eq=False)
class Linearity:
    """The amplitude of a motion, against the initial overlap 1.

    Attributes:
        elongation: the largest |change of length| of any contact, (*batch, *any) or (*batch, *any, time).
        stretch: the largest lengthening; a contact opens at 1. Same axes.
        force_deviation: the largest |F / F_linear - 1| of the Hertz contact (Eq. 9) at those elongations, about
            elongation / 4. Same axes.

    Example:
        >>> chain = tc.Chain(torch.ones(16))
        >>> tc.linearity(chain, tc.standing_wave(chain, tone=1, amplitude=0.01)).elongation.item() < 0.01
        True
    """

    elongation: Tensor
    stretch: Tensor
    force_deviation: Tensor


def linearity(chain: Chain, states: State | Trajectory) -> Linearity:
    """How nonlinear Hertz contacts would be, or are, in states of a chain.

    Args:
        chain: of any contact law.
        states: (*batch, *any, particle), or a trajectory.

    Returns:
        Linearity, one value per state.

    Example:
        >>> chain = tc.Chain(torch.ones(16))
        >>> found = tc.linearity(chain, tc.standing_wave(chain, tone=8, amplitude=0.1, phase="cos"))
        >>> round(found.elongation.item(), 3), round(found.force_deviation.item(), 3)
        (0.2, 0.052)
    """
    checks.instance("chain", chain, Chain)
    checks.instance("states", states, State, Trajectory)
    n = chain.n_particles
    displacement = checks.real_tensor("states", states.displacement)
    if displacement.ndim == 0 or displacement.shape[-1] != n:
        raise checks.fail("states", f"have {n} particles like the chain", displacement)
    elongation = chain.elongation(displacement)
    return Linearity(elongation.abs().amax(-1), elongation.amax(-1), force_deviation(elongation).amax(-1))


def force_deviation(elongation: Tensor) -> Tensor:
    """|F / F_linear - 1| of a Hertz contact at an elongation, both relative to the precompressed state (Eq. 9)."""
    # With q = 1 - sqrt(1 - e), so that e = q (2 - q): F / F_linear = (2/3) (3 - 3 q + q^2) / (2 - q).
    closed = elongation.clamp(max=1)
    q = closed / (1 + (1 - closed).sqrt())
    deviation = q * (3 - 2 * q) / (3 * (2 - q))
    return torch.where(elongation < 1, deviation.abs(), 1 - 2 / (3 * elongation.clamp(min=1)))


def elongation_bound(chain: Chain, state: State) -> Tensor:
    """The largest elongation, or compression of a Hertz contact, that the energy of a start allows, now and later, (*batch, *any).

    sqrt(2 E / kappa), as a compression x takes at least kappa x^2 / 2: rigorous, and reached only if all energy met in the softest contact, so far too large for
    a wave that extends over many particles.
    """
    softest = chain.align(chain.contact_stiffness.amin(-1, keepdim=True), state.displacement)[..., 0]
    return (2 * chain.energy(state.displacement, state.velocity) / softest).sqrt()


def elongation_estimate(chain: Chain, state: State) -> Tensor:
    """The elongation to expect from a start, (*batch, *any): the energy a contact and its two particles have at time 0.

    Exact for a wave that starts at rest and spreads; an impulse reaches about half of it.
    """
    energy = chain.align(chain.masses, state.velocity) * state.velocity.square()
    beside = chain.of_both_ends(energy)
    elongation = chain.elongation(state.displacement)
    stiffness = chain.align(chain.contact_stiffness, elongation)
    return (elongation.square() + beside / stiffness).sqrt().amax(-1)


def warn_if_nonlinear(chain: Chain, state: State, limit: float = 0.05, stacklevel: int = 2) -> None:
    """A :class:`LinearityWarning` where linear contacts are given a start too large for them.

    Args:
        chain: nothing is said of Hertz contacts.
        state: the start, (*batch, *any, particle).
        limit: largest relative deviation of the contact force that passes; 0.05 is an elongation of about 0.2.
        stacklevel: whose line the warning names, as in :func:`warnings.warn`.
    """
    if chain.contact != "linear":
        return
    with torch.no_grad():
        estimate = elongation_estimate(chain, state)
        if checks.is_transformed(estimate):
            return
        largest = estimate.amax()
        if largest.item() <= min(1, 3 * limit):  # a closed contact's deviation is at most a third of its elongation
            return
        deviation = force_deviation(largest).item()
        if not deviation > limit:
            return
        where = tuple(int(i) for i in (estimate == largest).nonzero()[0])
        bound = elongation_bound(chain, state)[where].item()
    opens = "contacts would open, " if largest >= 1 else ""
    warnings.warn(
        f"elongations of about {largest.item():.3g} of the initial overlap{checks.position(where)} (by energy at most "
        f"{bound:.3g}) are too large for linear contacts: {opens}their force is off by {100 * deviation:.2g} %, more "
        f"than {100 * limit:.2g} %; use a smaller amplitude, or contact='hertz'",
        LinearityWarning,
        stacklevel=stacklevel,
    )
