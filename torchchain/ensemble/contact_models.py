"""What a scene's contacts take: linear, linear plus quadratic terms, or full Hertz contacts, and where each stops being enough."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass

from torchchain import checks

OPENING = 0.2
"""Root mean square elongation from which contacts open: half a percent of them by the time that 0.4 of the energy has moved."""
# Total variation in twelve bands of frequency, measured on Hertz chains of 512 at disorder 0.3, elongations 0.025 to 0.2, starts in
# two bands, up to 8 over the squared elongation (experiments/harmonics.py). Linear contacts miss harmonics that are carried along,
# in proportion to the energy, and what resonant triads move, at a rate in proportion to the energy until it is spread: to 7 %, 28 %
# at most. Triads come as carried harmonics do not, and miss a share of what moves: to a factor of 1.6, 2.8 at most.
CARRIED, RATE, SPREAD = 0.27, 0.166, 0.46
EARLY, MISSED = 0.61, 0.097  # of triads: over the energy, and a share of what moves


@dataclass(frozen=True)
class ContactModel:
    """One way to treat the contacts of a chain.

    Attributes:
        name: "linear", "linear plus quadratic" (a master equation with triads, :mod:`torchchain.mixing`) or "hertz".
        error: predicted total variation of the energies in bands of frequency at the last time.
        edge: root mean square elongation up to which the error is within the tolerance.
        enough: whether it is here.

    Example:
        >>> [model.name for model in tc.plan(tc.Scene(n_particles=64, n_bands=8)).contact_models if model.enough]
        ['linear', 'linear plus quadratic', 'hertz']
    """

    name: str
    error: float
    edge: float
    enough: bool


def contact_models(elongation: float, end: float, tolerance: float) -> tuple[ContactModel, ...]:
    """The three ways, the least first, with what they are predicted to miss.

    Args:
        elongation: root mean square at the start, in initial overlaps: the square root of the energy per particle, in units
            of stiffness times overlap squared.
        end: the last time.
        tolerance: total variation allowed.

    Example:
        >>> from torchchain.ensemble.contact_models import contact_models
        >>> [model.enough for model in contact_models(elongation=0.05, end=200.0, tolerance=0.02)]
        [False, True, True]
    """
    elongation = checks.number("elongation", elongation, at_least=0)
    end, tolerance = checks.number("end", end, at_least=0), checks.number("tolerance", tolerance, above=0)
    found = []
    for name, error in (("linear", linear_error), ("linear plus quadratic", quadratic_error)):
        here = error(elongation, end)
        found.append(ContactModel(name, here, _edge(error, end, tolerance), here <= tolerance))
    return (*found, ContactModel("hertz", 0.0, math.inf, True))


def linear_error(elongation: float, end: float) -> float:
    """Total variation in bands of frequency between linear and Hertz chains."""
    energy = elongation**2
    return min(1.0, CARRIED * energy + SPREAD * -math.expm1(-RATE * energy * end))


def quadratic_error(elongation: float, end: float) -> float:
    """The same between triads and Hertz chains; infinite where contacts open."""
    if elongation > OPENING:
        return math.inf
    energy = elongation**2
    return EARLY * energy + MISSED * SPREAD * -math.expm1(-RATE * energy * end)


def _edge(error: Callable[[float, float], float], end: float, tolerance: float) -> float:
    step = (OPENING if math.isinf(error(1.0, end)) else 1.0) / 2**52  # errors grow with the elongation
    return step * (bisect_right(range(2**52 + 1), tolerance, key=lambda i: error(step * i, end)) - 1)
