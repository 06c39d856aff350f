"""The granular chain: masses, contacts and boundary, with its contact law (Eqs. 6-13)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks

BOUNDARIES = ("periodic", "fixed")
CONTACTS = ("linear", "hertz")


@dataclass(frozen=True, eq=False)
class Chain(checks.Fields):
    """Chains of beads, each in contact with its two neighbors; a batch shares boundary and contact law.

    Units: mean mass 1, contact stiffness 1, initial overlap 1, so that sound travels one particle per unit time.

    Contact c (counted from 0) joins particles c - 1 and c. A fixed chain of N particles has N + 1 contacts, the
    first and the last with a wall; a periodic one has N, contact 0 joining the last particle to the first.

    The Hertz contact force is (2/3) kappa (1 - e)^(3/2) for the elongation e < 1 and zero for an open contact,
    e >= 1: its slope at e = 0 is the linear contact's kappa, where Eq. 7 as printed would have (3/2) kappa and
    times shorter by sqrt(3/2). An open contact neither pulls nor damps, by every method.

    Attributes:
        masses: (*batch, particle), positive.
        boundary: "periodic" or "fixed".
        stiffness: kappa, a number or a tensor (contact,) or (*batch, contact), positive.
        contact: "linear" (Eq. 12) or "hertz" (Eq. 7).
        damping: contact damping force per relative velocity (Eq. 14), like ``stiffness`` but zero allowed.

    Raises:
        FieldError, FieldTypeError: for a value out of range, naming its realization and particle.

    Example:
        >>> masses = tc.Disorder(strength=0.3).masses(n_particles=8, realizations=2, seed=0)
        >>> chain = tc.Chain(masses, boundary="fixed")
        >>> chain.n_contacts, tuple(chain.masses.shape)
        (9, (2, 8))
    """

    masses: Tensor
    boundary: str = "periodic"
    stiffness: float | Tensor = 1.0
    contact: str = "linear"
    damping: float | Tensor = 0.0

    def __post_init__(self) -> None:
        masses = checks.real_tensor("masses", self.masses)
        if masses.ndim == 0 or masses.shape[-1] < 2:
            raise checks.fail("masses", "hold at least 2 particles on the last axis", masses)
        checks.first_bad("masses", "be positive", masses, masses <= 0, "particle")
        checks.choice("boundary", self.boundary, BOUNDARIES)
        checks.choice("contact", self.contact, CONTACTS)
        object.__setattr__(self, "masses", masses)
        object.__setattr__(self, "stiffness", self._per_contact("stiffness", self.stiffness, zero=False))
        object.__setattr__(self, "damping", self._per_contact("damping", self.damping, zero=True))

    def _per_contact(self, field: str, value: float | Tensor, zero: bool) -> Tensor:
        """The value as a tensor (contact,) or (*batch, contact), like the masses in dtype and device."""
        value = checks.real_tensor(field, value).to(self.masses)
        rule = "not be negative" if zero else "be positive"
        checks.first_bad(field, rule, value, value < 0 if zero else value <= 0, "contact")
        shape = (*self.batch_shape, self.n_contacts)
        if value.ndim == 0:
            return value.expand(self.n_contacts)
        if tuple(value.shape) not in (shape, shape[-1:]):
            raise checks.fail(field, f"be a number or have shape {shape[-1:]} or {shape}", value)
        return value

    @property
    def n_particles(self) -> int:
        return self.masses.shape[-1]

    @property
    def n_contacts(self) -> int:
        return self.n_particles + (not self.is_free)

    @property
    def contact_stiffness(self) -> Tensor:
        """The stiffness of every contact, (*batch, contact)."""
        return torch.as_tensor(self.stiffness).expand(*self.batch_shape, self.n_contacts)

    @property
    def contact_damping(self) -> Tensor:
        """The damping of every contact, (*batch, contact)."""
        return torch.as_tensor(self.damping).expand(*self.batch_shape, self.n_contacts)

    @property
    def batch_shape(self) -> torch.Size:
        return self.masses.shape[:-1]

    @property
    def is_damped(self) -> bool:
        return checks.first(torch.as_tensor(self.damping) > 0) is not None

    @property
    def is_free(self) -> bool:
        """Whether nothing holds the chain, so that it can move as a whole: a ring."""
        return self.boundary == "periodic"

    @property
    def rigid_mass(self) -> Tensor:
        """The mass that a rigid motion moves, (*batch,): that of a ring; infinite between walls, which allow none."""
        total = self.masses.sum(-1)
        return total if self.is_free else torch.full_like(total, torch.inf)

    @property
    def is_uniform_ring(self) -> bool:
        """Periodic, with equal linear contacts: the stiffness is diagonal in wavenumber space."""
        stiffness = torch.as_tensor(self.stiffness)
        if not self.is_free or self.contact != "linear" or checks.is_transformed(stiffness):
            return False
        return bool((stiffness == stiffness.flatten()[0]).all())

    def align(self, values: Tensor, field: Tensor) -> Tensor:
        """``values`` (*batch, x) shaped to multiply a ``field`` (*batch, *any, x) of states of these chains."""
        batch = len(self.batch_shape)
        if field.shape[:batch] != self.batch_shape or field.ndim <= batch:
            rule = f"have leading axes {tuple(self.batch_shape)} like the chain's masses"
            raise checks.fail("state", rule, field)
        if values.ndim == 1:
            return values
        return values.reshape(*self.batch_shape, *[1] * (field.ndim - batch - 1), values.shape[-1])

    # The shape of a chain is in the following five: elongations A u with the incidence matrix A, forces -A^T T, the same
    # without signs, and the contacts in the order in which kernels walk along them.

    def elongation(self, displacement: Tensor) -> Tensor:
        """Change of length of every contact, (*batch, *any, contact): right minus left displacement, walls at 0."""
        if self.is_free:
            return displacement - displacement.roll(1, -1)
        return torch.nn.functional.pad(displacement, (1, 1)).diff(dim=-1)

    def net(self, tension: Tensor) -> Tensor:
        """Force on every particle, (*batch, *any, particle): tension of its right contact minus that of its left."""
        return tension.roll(-1, -1).sub_(tension) if self.is_free else tension.diff(dim=-1)

    def of_both_ends(self, field: Tensor) -> Tensor:
        """A quantity of the particles summed over both ends of every contact, (*batch, *any, contact); walls have none."""
        if self.is_free:
            return field + field.roll(1, -1)
        padded = torch.nn.functional.pad(field, (1, 1))
        return padded[..., 1:] + padded[..., :-1]

    def of_both_contacts(self, field: Tensor) -> Tensor:
        """A quantity of the contacts summed over both of every particle, (*batch, *any, particle)."""
        return field + field.roll(-1, -1) if self.is_free else field[..., 1:] + field[..., :-1]

    def in_a_row(self, field: Tensor) -> Tensor:
        """A quantity of the contacts on the left of particle 1, 2, ..., N and on the right of N, (*batch, N + 1)."""
        return torch.cat([field, field[..., :1]], dim=-1) if self.is_free else field

    def without_rigid_motion(self, displacement: Tensor, factor: float = 1.0) -> Tensor:
        """The displacement counted from where the chain has moved as a whole, the mean by mass, times a factor; between walls as it is."""
        mass = self.rigid_mass
        if not checks.is_transformed(mass) and bool(mass.isinf().all()):
            return displacement if factor == 1 else displacement * factor
        moment = (self.align(self.masses, displacement) * displacement).sum(-1, keepdim=True)
        return torch.add(moment / self.align(mass[..., None] / -factor, displacement), displacement, alpha=factor)

    def tension(self, elongation: Tensor) -> Tensor:
        """Pull of every contact relative to the precompressed state, (*batch, *any, contact)."""
        stiffness = self.align(self.contact_stiffness, elongation)
        if self.contact == "linear":
            return stiffness * elongation
        # (2/3) (1 - (1 - e)^(3/2)) without cancellation: with s = sqrt(1 - e) and q = 1 - s, 1 - s^3 = q (3 - 3 q + q^2).
        q = _hertz_variable(elongation)
        return stiffness * (2 / 3) * q * (3 - 3 * q + q * q)

    def force(self, displacement: Tensor) -> Tensor:
        """Contact force on every particle, K u for linear contacts (Eqs. 7, 13), (*batch, *any, particle)."""
        return self.net(self.tension(self.elongation(displacement)))

    def active_damping(self, displacement: Tensor) -> Tensor:
        """The damping of every contact in a state, zero where a Hertz contact is open, (*batch, *any, contact)."""
        elongation = self.elongation(displacement)
        damping = self.align(self.contact_damping, elongation)
        return damping if self.contact == "linear" else damping * (elongation < 1)

    def damping_force(self, velocity: Tensor, displacement: Tensor | None = None) -> Tensor:
        """Damping force -D v on every particle (Eq. 14), (*batch, *any, particle).

        Args:
            velocity: (*batch, *any, particle).
            displacement: the same; tells which contacts are open, and only Hertz contacts need it.

        Raises:
            FieldError: for Hertz contacts without a displacement.
        """
        rate = self.elongation(velocity)
        if self.contact == "linear":
            return self.net(self.align(self.contact_damping, rate) * rate)
        if displacement is None:
            raise checks.fail("displacement", "be given for Hertz contacts, which do not damp while open", "None")
        return self.net(self.active_damping(displacement) * rate)

    def contact_energy(self, displacement: Tensor) -> Tensor:
        """Potential energy of every contact relative to the precompressed state, (*batch, *any, contact), never negative."""
        elongation = self.elongation(displacement)
        stiffness = self.align(self.contact_stiffness, elongation)
        if self.contact == "linear":
            return stiffness * elongation.square() / 2
        # (2/3) [e - (2/5) (1 - (1 - e)^(5/2))] as a polynomial in q; an open contact adds (2/3) per unit length.
        q = _hertz_variable(elongation)
        closed = q * q * (3 - 4 * q + 2 * q * q - 0.4 * q**3)
        return stiffness * (2 / 3) * (closed + (elongation - 1).clamp(min=0))

    def energy(self, displacement: Tensor, velocity: Tensor) -> Tensor:
        """Energy of the chain relative to the precompressed state (Eq. 41), (*batch, *any)."""
        kinetic = (self.align(self.masses, velocity) * velocity.square()).sum(-1) / 2
        return kinetic + self.contact_energy(displacement).sum(-1)

    def open_contacts(self, displacement: Tensor) -> Tensor:
        """Whether each contact is open (the elongation has used up the initial overlap 1), (*batch, *any, contact)."""
        return self.elongation(displacement) >= 1

    def stiffness_matrix(self) -> Tensor:
        """K of Eq. 13, symmetric and negative semidefinite, (*batch, particle, particle)."""
        unit = torch.eye(self.n_particles, dtype=self.masses.dtype, device=self.masses.device)
        return self.net(self.contact_stiffness[..., None, :] * self.elongation(unit))

    def squared_frequency_bound(self, sweeps: int = 30) -> Tensor:
        """A rigorous upper bound on every squared frequency of the linear chain, (*batch,).

        The largest eigenvalue of A = -M^-1 K is at most that of |A|, and for a non-negative matrix max (|A| x) / x
        over the particles bounds it from above for any positive x (Collatz and Wielandt). Some power steps make x
        a good one; the bound holds after any number of them. Two ulps cover the rounding.
        """
        stiffness = self.contact_stiffness
        x = torch.ones_like(self.masses)
        for _ in range(sweeps):
            image = self.of_both_contacts(stiffness * self.of_both_ends(x)) / self.masses
            # The geometric mean of x and its image stays positive and does not alternate between neighbors.
            x = (x * image).sqrt()
            x = x / x.amax(-1, keepdim=True)
            x = x.clamp(min=torch.finfo(x.dtype).tiny ** 0.25)
        ratio = self.of_both_contacts(stiffness * self.of_both_ends(x)) / self.masses / x
        return ratio.amax(-1) * (1 + 8 * torch.finfo(x.dtype).eps)


def _hertz_variable(elongation: Tensor) -> Tensor:
    """q = 1 - sqrt(1 - e) = e / (1 + sqrt(1 - e)); 1 for an open contact.

    The root's slope is infinite where a contact opens, where the force's is zero: no gradient passes through it there.
    """
    is_open = elongation >= 1
    closed = elongation.masked_fill(is_open, 0)
    return (closed / (1 + (1 - closed).sqrt())).masked_fill(is_open, 1)
