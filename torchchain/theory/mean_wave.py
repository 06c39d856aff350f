"""The mean wave of an infinite chain without approximation, for masses of a few values.

Few masses, as of a binary law, make few kinds of clusters, whose resonances stand at the same frequencies everywhere: the
mean resolvent has sharp lines there, and the mean wave beats for hundreds of units of time. No effective medium of single
particles has these lines, but in one dimension the mean can be taken exactly. The ratio of neighboring amplitudes on
one side of a particle obeys rho_n = 1 / (2 - z^2 m_n - rho_(n+1)), and

    G_00 = 1 / (2 - z^2 m_0 - rho_left - rho_right),    G_0x = G_00 rho_1 ... rho_x.

Each step maps the upper half-plane into the disk Im 1 / rho < -Im z^2 m of the lightest particle, and that well into itself. So with
s = (1 / rho - 1 / p) / (1 / rho - 1 / p'), p a ratio in the disk and p' its reflection at the edge, means of analytic functions of
rho follow from the moments < s^n >, and one step is a matrix on their Taylor coefficients: (Cf)(s) = < f(s') >. The moments are its fixed
point, and sums over x with exp(ikx) are resolvents of D, (Df)(s) = < rho' f(s') >. Where every particle is far from its resonance,
or above it, the unit disk of rho takes the place of that disk. The orders that are kept converge as fast as Im z allows.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchchain.theory.ladder import (
    Stretch,
    Waves,
    coherent_energy,
    fading,
    line,
    mirrored,
    spectrum_edges,
    window_of,
)
from torchchain.theory.law import Law
from torchchain.theory.medium import coherent_mass, site_resolvent

MOST_VALUES = 8
"""Of a law whose mean wave is computed."""
LAST = 800.0
"""Time up to which it is; from half of it on its difference from the medium's fades."""
_EARLY, _ENOUGH = 40.0, 60.0  # end of the first stretch of times, and of what its grid could reach
_DECAY, _LATE_DECAY = 6.0, 4.0  # eta times period: of the next period's, against what exp(eta t) makes of errors
_SMOOTH, _LATE_SMOOTH = 0.8, 0.225  # widths of the windows at the spectrum's end
_BEYOND = 0.4  # above the edge of the spectrum by this, the medium is exact enough
_ORDERS, _EARLY_ORDERS = 32, 36  # Taylor coefficients
_OVERSAMPLED, _RADIUS = 3, 0.9  # nodes an order, on a circle of this radius, for Taylor coefficients
_BLOCK = 100  # frequencies at a time
_FAR, _ABOVE = 2.3, -2.05  # from |2 - z^2 m| or to 2 - z^2 m on, particles are far from or above resonance


def mean_resolvent(z: Tensor, law: Law, wavenumbers: Tensor, orders: int = _ORDERS) -> tuple[Tensor, Tensor]:
    """< (K - z^2 M)^-1 > of plane waves in an infinite chain, [wavenumber, frequency], and that of the effective medium.

    Args:
        z: with positive real and imaginary parts, (frequency,).
        law: of the masses; the cost grows with its values.
        wavenumbers: k, (wavenumber,).
        orders: Taylor orders kept.

    Example:
        >>> from torchchain.theory.law import law_of
        >>> from torchchain.theory.mean_wave import mean_resolvent
        >>> z, k = torch.tensor([1.0 + 0.3j, 2.0 + 0.3j], dtype=torch.complex128), torch.tensor([1.5], dtype=torch.float64)
        >>> exact, medium = mean_resolvent(z, law_of(tc.Disorder("binary", 0.5)), k)
        >>> ((exact - medium).abs() / exact.abs()).round(decimals=2).tolist()  # more at the light particles' resonance
        [[0.01, 0.11]]
    """
    mass, _ = coherent_mass(z, law)
    argument = z.square() * mass
    inverse = 2 - z.square()[:, None] * law.values  # (frequency, value)
    far = (inverse.abs().amin(-1) > _FAR) | (inverse.real.amax(-1) < _ABOVE)
    inner, outer = _disk(inverse, (2 - argument + 1 / site_resolvent(argument)) / 2)
    weights = law.weights.to(z)
    nodes = _OVERSAMPLED * orders
    order, node = torch.arange(orders), torch.arange(nodes)
    circle = _RADIUS * torch.exp(2j * math.pi * node.double() / nodes)
    taylor = torch.exp(-2j * math.pi * (order[:, None] * node).double() / nodes) / nodes
    taylor = (taylor * _RADIUS ** -order.double()[:, None]).T  # values at the nodes times this are coefficients
    at = torch.where(far[:, None], circle, (1 - circle) / (inner[:, None] - outer[:, None] * circle))
    onto = inverse[..., None] - at[:, None]  # (frequency, value, node)
    ratio = 1 / onto
    step = torch.where(far[:, None, None], ratio, (onto - inner[:, None, None]) / (onto - outer[:, None, None]))
    once, onward = torch.empty(2, len(z), orders, nodes, dtype=z.dtype)
    power = weights[:, None].expand_as(step)
    for n in range(orders):
        once[:, n], onward[:, n] = power.sum(1), (power * ratio).sum(1)
        power = power * step
    once, onward = once @ taylor, onward @ taylor
    eye = torch.eye(orders, dtype=z.dtype)
    moments = torch.ones(len(z), orders, dtype=z.dtype)
    moments[:, 1:] = torch.linalg.solve((eye - once)[:, 1:, 1:], once[:, 1:, 0])
    density = moments @ taylor.T
    local = torch.zeros_like(at)
    for weight, here in zip(weights, inverse.T, strict=True):
        local += weight * (density[:, None] @ (1 / (here[:, None, None] - at[:, :, None] - at[:, None])))[:, 0]
    local = local @ taylor
    # Both directions: sums of 1 / (exp(-ik) - D) + 1 / (exp(ik) - D) in the eigenvectors of D.
    values, vectors = torch.linalg.eig(onward)
    first = torch.linalg.solve(vectors, (onward @ moments[..., None])[..., 0])
    parts = first * (local[:, None] @ vectors)[:, 0]
    turn = torch.exp(1j * wavenumbers)[:, None, None]
    swept = (parts * (1 / (turn - values) + 1 / (1 / turn - values))).sum(-1)
    exact = (moments * local).sum(-1) + swept
    return exact, 1 / (4 * torch.sin(wavenumbers / 2).square()[:, None] - argument)


def _disk(inverse: Tensor, medium: Tensor) -> tuple[Tensor, Tensor]:
    """1 / rho at the center of the disk in which every ratio lies, and at its reflection, (frequency,).

    Im 1 / rho is below the smallest loss of a particle, c: that is a disk, which each step maps well into itself. Its center is
    the medium's ratio, and that of a chain of the lightest particles alone where all others are above their resonance.

    Args:
        inverse: 2 - z^2 m, (frequency, value).
        medium: 1 / rho of the medium, (frequency,).
    """
    order = inverse.real.argsort(-1, descending=True)
    light = inverse.gather(-1, order[:, :1])[:, 0]
    root = (light.square() - 4).sqrt()
    alone = (light + torch.where((light + root).abs() > (light - root).abs(), root, -root)) / 2
    above = (inverse.gather(-1, order[:, 1:]).real < -2).all(-1)
    center = torch.where(above, alone, medium)
    return center, center.conj() - 2j * (-inverse.imag).amin(-1)


def mean_wave_energy(law: Law, waves: Waves, times: Tensor) -> tuple[Tensor, Tensor]:
    """Energy of the mean wave in its own band, [source, time]: the effective medium's and the chain's."""
    medium = torch.ones(len(waves.sources), len(times), dtype=torch.float64)
    exact = medium.clone()
    edge = spectrum_edges(law)[0]
    for start, stop in ((0.0, _EARLY), (_EARLY, LAST / 2), (LAST / 2, LAST)):
        inside = (times > start) & (times <= stop)
        if bool(inside.any()):  # by one grid, whatever times are asked for
            found = _energies(law, waves, times[inside], _stretch(start, stop, edge), edge + _BEYOND)
            medium[:, inside], exact[:, inside] = found
    medium[:, times > LAST] = exact[:, times > LAST] = 0
    return medium, medium + (exact - medium) * fading(times, LAST)


def _stretch(start: float, stop: float, edge: float) -> Stretch:
    smooth, decay = (_LATE_SMOOTH, _LATE_DECAY) if start > 0 else (_SMOOTH, _DECAY)
    cut, period = edge + 3.5 * smooth, max(stop, _ENOUGH) + 13.5 / smooth
    step = math.pi / period
    return Stretch(start, stop, decay / period, step, cut, smooth, math.ceil((cut + 4 * smooth) / step))


def _energies(law: Law, waves: Waves, times: Tensor, stretch: Stretch, highest: float) -> tuple[Tensor, Tensor]:
    z, loss, inner, _, argument = line(law, waves, stretch)
    ring = 1 / (waves.sources[:, None] - argument)
    below = int((z.real < highest).sum())
    orders = _ORDERS if stretch.start > 0 else _EARLY_ORDERS
    found = [mean_resolvent(some, law, waves.wavenumbers, orders) for some in inner[:below].split(_BLOCK)]
    change = torch.cat([exact - medium for exact, medium in found], dim=-1)
    change = torch.nn.functional.pad(change, (0, len(z) - below))
    whole, loss = mirrored(z, -1), mirrored(loss)
    window = window_of(whole, stretch)
    energies = [
        coherent_energy(law, waves, times, stretch, whole, mirrored(mean) / loss, loss, window)
        for mean in (ring, ring + change)
    ]
    return energies[0], energies[1]
