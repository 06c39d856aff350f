"""The effective medium of a disordered chain: coherent potential approximation for any law of masses.

A random chain's mean resolvent < (K - z^2 M)^-1 > is that of an ordered chain whose mass mu(z) depends on frequency. The
coherent potential approximation (Soven 1967, Taylor 1967) chooses mu so that one particle of the random chain, put into
this chain, scatters nothing on average:

    < V / (1 - V g) > = 0,    V = z^2 (m - mu),    g = (1/N) sum_q 1 / (w_q^2 - z^2 mu),    w_q = 2 sin(q / 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchchain import checks
from torchchain.chain import Disorder
from torchchain.theory.law import Law, law_of

_STEPS, _DAMPED_STEPS = 150, 60  # of the iteration at most, and at its start that are Newton's only where it is near
_NEAR = 0.5  # a step of Newton's method is taken up to this share of the value
_ABOVE_THE_AXIS = 1e-7  # a real frequency is taken as its limit from above


@dataclass(frozen=True, eq=False)
class Levels:
    """Squared frequencies of an ordered lattice of one displacement per particle, which stand for its wavevectors.

    Attributes:
        squares: w_q^2, each once, (level,).
        weights: share of the wavevectors at each, (level,).

    Example:
        >>> from torchchain.theory.medium import Levels, site_resolvent
        >>> ring = Levels(torch.tensor([0.0, 2.0, 4.0], dtype=torch.float64), torch.tensor([0.25, 0.5, 0.25], dtype=torch.float64))
        >>> at = torch.tensor([1.0 + 0.5j], dtype=torch.complex128)
        >>> torch.allclose(site_resolvent(at, ring), site_resolvent(at, 4))  # a chain of four
        True
    """

    squares: Tensor
    weights: Tensor


@dataclass(frozen=True, eq=False)
class EffectiveMedium:
    """Mean properties of waves of each frequency, every tensor (frequency,).

    Attributes:
        frequencies: w, in units where the ordered chain's band ends at 2.
        mass: effective mass mu(w), complex; its imaginary part is the scattering out of a plane wave.
        resolvent: g(w) = (1/N) sum_q 1 / (w_q^2 - w^2 mu), complex, with a positive imaginary part.
        wavenumber: complex q of the coherent wave, 4 sin^2(q / 2) = w^2 mu, its real part in [0, pi].
        density_of_states: modes per particle and unit of frequency.
        mean_free_path: of the coherent intensity, 1 / (2 Im q), in particles.
        localization_length: 1 / gamma of a mode's amplitude, twice Im q being four times gamma for weak disorder, where
            forward and backward scattering are equal: 2 / Im q.
        residual: largest error of the self-consistency, in masses.

    Example:
        >>> medium = tc.theory.effective_medium(tc.Disorder(strength=0.1), [0.5, 1.0])
        >>> medium.mean_free_path.diff().lt(0).tolist(), medium.residual < 1e-8  # short waves are scattered sooner
        ([True], True)
    """

    frequencies: Tensor
    mass: Tensor
    resolvent: Tensor
    wavenumber: Tensor
    density_of_states: Tensor
    mean_free_path: Tensor
    localization_length: Tensor
    residual: float

    def spectral_function(self, wavenumbers: Any) -> Tensor:
        """A_k(w): how the energy of a wave k at rest is spread over frequency, (wavenumber, frequency), integral 1 over w."""
        k = checks.real_tensor("wavenumbers", wavenumbers).to(torch.float64)
        w = self.frequencies
        squared = (4 * torch.sin(k / 2).square())[:, None]
        return (2 / (math.pi * w)) * squared * (1 / (squared - w.square() * self.mass)).imag


def effective_medium(
    disorder: Disorder,
    frequencies: Any,
    n_particles: int | None = None,
    broadening: float = _ABOVE_THE_AXIS,
    strength: Tensor | None = None,
) -> EffectiveMedium:
    """The coherent potential of a chain with random masses, by quadrature over their whole law.

    For a chain of equal masses with random stiffnesses call it with the law of the compliance 1 / stiffness: tensions in
    contacts obey the equation of displacements of particles with the compliances for masses.

    Args:
        disorder: of the masses, any kind.
        frequencies: w > 0, (frequency,).
        n_particles: of a ring, whose q are 2 pi n / N; None for the infinite chain.
        broadening: imaginary part of the frequency. A ring has separate levels below its level spacing, pi / N or so.
        strength: a scalar in place of the disorder's; all that depends on it can be differentiated by ``backward``.

    Raises:
        FieldError: for frequencies that are not positive, or a strength that is no scalar.

    Example:
        >>> from torchchain import Disorder
        >>> medium = effective_medium(Disorder(strength=0.3), [0.5, 1.0, 1.5])
        >>> [round(x, 1) for x in medium.mean_free_path.tolist()]
        [84.6, 17.3, 4.8]
        >>> xi = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
        >>> path = effective_medium(Disorder(), [1.0], strength=xi).mean_free_path.sum()
        >>> path.backward()
        >>> round(float(xi.grad / path) * 0.3, 1)  # nearly as 1 / xi^2
        -1.9
    """
    checks.instance("disorder", disorder, Disorder)
    w = checks.real_tensor("frequencies", frequencies).to(torch.float64)
    if w.ndim != 1:
        raise checks.fail("frequencies", "be one-dimensional", w)
    checks.first_bad("frequencies", "be positive", w, w <= 0)
    if n_particles is not None:
        n_particles = checks.integer("n_particles", n_particles, 2)
    broadening = checks.number("broadening", broadening, above=0)
    z = torch.complex(w, torch.full_like(w, broadening))
    mass, residual = coherent_mass(z, law_of(disorder, strength=strength), n_particles)
    return _described(w, z, mass, n_particles, residual)


def _described(w: Tensor, z: Tensor, mass: Tensor, n_particles: int | None, residual: float) -> EffectiveMedium:
    argument = z.square() * mass
    g = site_resolvent(argument, n_particles)
    q = wavenumber(argument)
    density = (2 / (math.pi * w)) * (argument * g).imag
    return EffectiveMedium(w, mass, g, q, density, 1 / (2 * q.imag), 2 / q.imag, residual)


def born_rates(strength: float, wavenumbers: Any) -> Tensor:
    """Rate at which a plane wave loses coherent energy for weak disorder, 2 xi^2 sin(k/2) tan(k/2), (wavenumber,).

    Fermi's golden rule, Gamma = (pi/2) xi^2 w^2 g(w) with the ordered chain's density of states g = 1 / (pi cos(k/2))
    (Tamura 1983 for mass disorder in crystals).

    Args:
        strength: xi.
        wavenumbers: k, (wavenumber,), 0 to below pi.

    Example:
        >>> tc.theory.born_rates(0.1, [0.5, 1.0]).round(decimals=5).tolist()
        [0.00126, 0.00524]
    """
    strength = checks.number("strength", strength, at_least=0)
    k = checks.real_tensor("wavenumbers", wavenumbers).to(torch.float64)
    return 2 * strength**2 * torch.sin(k / 2) * torch.tan(k / 2)


def coherent_mass(
    z: Tensor, law: Law, n_particles: int | Levels | None = None, start: Tensor | None = None, tolerance: float = 1e-11
) -> tuple[Tensor, float]:
    """mu(z) for complex frequencies with Re z > 0 and Im z > 0, (frequency,), and the largest residual.

    Damped iteration of mu = s - 1 / H(s), s = mu + 1 / (z^2 g), H(s) = < 1 / (s - m) >, which is the condition of no
    scattering and converges in the upper half-plane; then Newton's method. Where z or the law carry derivatives, forward or
    backward, one more Newton step from the solution, whose slope is a constant, has those of the implicit function.
    """
    if len(law.values) == 1:
        return torch.full_like(z, float(law.values[0])), 0.0
    followed = _followed(z, law.values, law.weights)
    whole, z = z, plain(z)
    values, weights = plain(law.values), plain(law.weights).to(z)
    mass = torch.full_like(z, law.mean) if start is None else plain(start).clone()

    def mismatch(
        squared: Tensor, mass: Tensor, values: Tensor = values, weights: Tensor = weights
    ) -> tuple[Tensor, Tensor]:
        g, slope = _resolvent_and_slope(squared * mass, n_particles)
        apart = 1 / (squared * g)
        inverse = 1 / ((mass + apart)[:, None] - values)
        mean, mean_slope = inverse @ weights, -inverse.square() @ weights
        shift = 1 - apart / g * slope * squared
        return 1 / mean - apart, 1 - shift - shift * mean_slope / mean.square()

    # Newton's steps for what is near; the rest takes the damped iteration's, which converges from anywhere above the axis.
    active = torch.arange(len(z))
    residual = torch.zeros_like(z.real)
    for step in range(_STEPS):
        squared, here = z[active].square(), mass[active]
        off, slope = mismatch(squared, here)
        residual[active] = off.abs()
        open_ = ~(off.abs() < tolerance)
        if not bool(open_.any()):
            break
        active, squared, here, off, slope = active[open_], squared[open_], here[open_], off[open_], slope[open_]
        newton = off / slope
        trial = here - newton
        good = ((squared * trial).imag > 0) & (newton.abs() < _NEAR * here.abs())
        if start is None and step < _DAMPED_STEPS:
            good &= off.abs() < 1e-3
        mass[active] = torch.where(good, trial, here - 0.5 * off)
    if followed:
        off, slope = mismatch(whole.square(), mass, law.values, law.weights.to(z))
        mass = mass - off / plain(slope)
    return mass, float(residual.max())


def plain(tensor: Tensor) -> Tensor:
    """Without derivatives."""
    return forward_ad.unpack_dual(tensor).primal.detach()


def _followed(*tensors: Tensor) -> bool:
    """Whether any carries derivatives."""
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return True
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def site_resolvent(argument: Tensor, n_particles: int | Levels | None = None) -> Tensor:
    """g(e) = (1/N) sum_q 1 / (w_q^2 - e) for complex e, of a ring of N, w_q = 2 sin(q/2), or the levels of another lattice;
    the infinite chain's 1 / sqrt(e (e - 4)) for None."""
    return _resolvent_and_slope(argument, n_particles)[0]


def _resolvent_and_slope(e: Tensor, n_particles: int | Levels | None) -> tuple[Tensor, Tensor]:
    if isinstance(n_particles, Levels):
        inverse, weights = 1 / (n_particles.squares - e[..., None]), n_particles.weights.to(e)
        return inverse @ weights, inverse.square() @ weights
    g = -1 / (e * torch.sqrt(1 - 4 / e))
    slope = -(e - 2) / (e * (e - 4)) * g
    if n_particles is None:
        return g, slope
    # The images of the ring: a wave that has gone around is smaller by p^N, p + 1/p = 2 - e, 1/p - p = 1/g.
    once = (2 / (2 - e + 1 / g)).pow(n_particles)
    images = (1 + once) / (1 - once)
    return g * images, slope * images + g * (2 * n_particles * once * g) / (1 - once).square()


def wavenumber(argument: Tensor) -> Tensor:
    """Complex q with 4 sin^2(q/2) = e, Re q in [0, pi], Im q > 0."""
    q = 2 * torch.asin(torch.sqrt(argument) / 2)
    return torch.complex(q.real.abs(), q.imag.abs())
