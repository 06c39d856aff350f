"""From beads in SI units to the dimensionless chain and back (Eqs. 1-5)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, fields
from typing import Any

from torchchain import checks
from torchchain.chain.chain import Chain

QUANTITIES = ("time", "length", "velocity", "mass", "force", "energy", "stiffness", "frequency", "damping")


@dataclass(frozen=True)
class Scaling(checks.Fields):
    """A chain of equal elastic spheres under a precompression force, and the units it sets.

    Two spheres of radius a in contact push with F = kappa delta^(3/2), kappa = E sqrt(2 a) / (3 (1 - nu^2)) (Hertz; Johnson,
    Contact Mechanics, 1985, Eq. 4.23), so that the force P makes the overlap (P / kappa)^(2/3) (Eq. 2), the unit of
    length for displacements. The unit of time is sqrt(m / k) with the contact's stiffness k = (3/2) kappa overlap^(1/2)
    at that overlap: the paper's t_c (Eq. 4) has kappa overlap^(1/2) in place of k and is longer by sqrt(3/2).

    Attributes:
        radius: of a bead of mean mass, m.
        density: kg / m^3.
        young_modulus: Pa.
        poisson_ratio: 0 to 0.5.
        force: precompression, N.

    Example:
        >>> beads = tc.Scaling(radius=5e-3, density=7850.0, young_modulus=2e11, poisson_ratio=0.3, force=10.0)
        >>> f"{beads.sound_speed:.0f} m/s, overlap {beads.overlap:.1e} m, unit of time {beads.unit('time'):.1e} s"
        '545 m/s, overlap 1.2e-06 m, unit of time 1.8e-05 s'
    """

    radius: float
    density: float
    young_modulus: float
    poisson_ratio: float
    force: float

    def __post_init__(self) -> None:
        for entry in fields(self):
            bounds: dict[str, float] = (
                {"above": -1.0, "at_most": 0.5} if entry.name == "poisson_ratio" else {"above": 0.0}
            )
            object.__setattr__(self, entry.name, checks.number(f"si.{entry.name}", getattr(self, entry.name), **bounds))
        try:
            units = [self.unit(quantity) for quantity in QUANTITIES]
        except (OverflowError, ZeroDivisionError):
            units = []
        if not units or not all(0 < unit < math.inf for unit in units):
            given = ", ".join(f"{entry.name} {getattr(self, entry.name):g}" for entry in fields(self))
            raise checks.fail("si", "give units that are finite numbers above 0", given)
        if self.overlap >= 0.1 * self.radius:
            raise checks.fail(
                "si.force", "make an overlap below a tenth of the radius, where Hertz contacts hold", self.force
            )

    @property
    def contact_constant(self) -> float:
        """kappa of F = kappa delta^(3/2), N / m^(3/2)."""
        return self.young_modulus * math.sqrt(2 * self.radius) / (3 * (1 - self.poisson_ratio**2))

    @property
    def overlap(self) -> float:
        """Initial overlap of two beads, the unit of displacement, m (Eq. 2)."""
        return (self.force / self.contact_constant) ** (2 / 3)

    @property
    def spacing(self) -> float:
        """Distance of neighboring beads at rest, m."""
        return 2 * self.radius - self.overlap

    @property
    def sound_speed(self) -> float:
        """Speed of long waves in the ordered chain, m / s: one spacing per unit of time."""
        return self.spacing / self.unit("time")

    def unit(self, quantity: str) -> float:
        """The SI value of the dimensionless 1 of a quantity.

        Args:
            quantity: "time" (s), "length" of displacements (m), "velocity" (m/s), "mass" (kg), "force" (N), "energy" (J),
                "stiffness" (N/m), "frequency" (Hz per dimensionless angular frequency) or "damping" (kg/s).
        """
        checks.choice("quantity", quantity, QUANTITIES)
        mass = 4 / 3 * math.pi * self.radius**3 * self.density
        length = self.overlap
        return derived_units(mass, 1.5 * self.contact_constant * math.sqrt(length), length)[quantity]

    def to_si(self, quantity: str, value: Any) -> Any:
        """A dimensionless value in SI units; tensors and arrays pass through."""
        return value * self.unit(quantity)

    def from_si(self, quantity: str, value: Any) -> Any:
        """A value in SI units made dimensionless; tensors and arrays pass through."""
        return value / self.unit(quantity)


def derived_units(mass: float, stiffness: float, length: float) -> dict[str, float]:
    """Units of all quantities from those of three."""
    time = math.sqrt(mass / stiffness)
    return {
        "time": time,
        "length": length,
        "velocity": length / time,
        "mass": mass,
        "force": stiffness * length,
        "energy": stiffness * length**2,
        "stiffness": stiffness,
        "frequency": 1 / (2 * math.pi * time),
        "damping": stiffness * time,
    }


FAR = 2.0
"""Mean masses beyond this, or below one over it, are remarked upon."""


class UnitsWarning(UserWarning):
    """Masses whose mean is far from 1, the unit here: times are then no longer those of sound over one particle.

    Example:
        >>> import warnings
        >>> chain = tc.Chain(torch.full((16,), 2.5e-4, dtype=torch.float64))  # in kg, perhaps
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     _ = tc.evolve(chain, tc.impulse(chain), [0.0, 1.0])
        >>> [warning.category.__name__ for warning in told]
        ['UnitsWarning']
    """


def warn_if_unscaled(chain: Chain, stacklevel: int = 2) -> None:
    """A :class:`UnitsWarning` where the masses of chains have a mean far from 1.

    Args:
        chain: masses (*batch, particle).
        stacklevel: whose line the warning names, as in :func:`warnings.warn`.
    """
    if checks.is_transformed(chain.masses):
        return
    mean, stiffness = (field.detach().mean().item() for field in (chain.masses, chain.contact_stiffness))
    warn_of_mean(mean, stiffness, stacklevel + 1)


def warn_of_mean(mean: float, stiffness: float = 1.0, stacklevel: int = 2) -> None:
    """The same of a mean mass, beside the mean stiffness of the contacts."""
    if 1 / FAR <= mean <= FAR:
        return
    speed = math.sqrt(stiffness / mean)
    warnings.warn(
        f"masses have mean {mean:.3g}, where the unit of mass is their mean: sound travels {speed:.3g} particles per unit of "
        "time, not one (divide masses by their mean and stiffnesses by theirs, or see Scaling)",
        UnitsWarning,
        stacklevel=stacklevel,
    )
