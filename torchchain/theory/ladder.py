"""Energy transfer between wavenumbers by the conserving ladder, at finite times.

In the effective medium every energy is a product of two resolvents, at z above and at z~ below the real axis. With the
vertex of Velicky (1969), which keeps the Ward identity of the coherent potential,

    < G_qk(z) G_qk(z~) > = G_k G~_k [ delta_qk + X(z, z~) G_q G~_q / N ],
    1 / X = (z^2 g - z~^2 g~) / (z^2 z~^2 (mu - mu~)) - (g - g~) / (z^2 mu - z~^2 mu~),

for any law of masses: averaging the t-matrices leaves no trace of the law but mu. Both energies of wavenumber q follow
from G_qk with one factor (z + z~)^2 / (2 z^2 z~^2), so that one double integral over the line Im z = eta, exact for every
eta > 0, gives the energy at time t. The sum over the receiving wavenumbers is closed:

    sum_q w_q^2 G_q G~_q = (sum_q w_q^2 G_q - sum_q w_q^2 G~_q) / (e - e~),    e = z^2 mu,

so a pair of frequencies costs one product for every source and receiving band, whatever the number of particles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy import special
from torch import Tensor
from torch.autograd import forward_ad

from torchchain.theory.law import Law
from torchchain.theory.medium import Levels, coherent_mass, site_resolvent

FIRST, RATIO = 4.0, 10.0  # end of the first stretch of times, and how many times longer each next is
DECAY = 9.0  # eta times the period of the time grid: exp(-2 DECAY) = 1.5e-8 of a period's energy comes back
_FIRST_CUT = 60.0  # frequencies kept for the first stretch: what starts as t^4 falls off as frequency^-5
_SMOOTH = 9.0  # width of the frequency cut times the first time of a stretch: exp(-(_SMOOTH/2)^2) = 2e-9
_LATE = 400.0  # stretches that start here or later are averaged over time ...
_AVERAGE = 10.0  # ... with this standard deviation
_BLOCK = 2**22  # complex numbers of the spectrum kept at a time
_TAIL, _LATE_TAIL = 3e-7, 1e-3  # share of the modes beyond the last frequency, and of a late stretch


@dataclass(frozen=True, eq=False)
class Waves:
    """The ring of wavenumbers, the sources and the receiving bands.

    Attributes:
        n_particles: N.
        n_bands: B.
        sources: w_k^2 of the sources, (source,).
        source_bands: band of each source, from 0, (source,).
        momentum: whether sources start as momenta (the dual of stiffness disorder) and not as displacements.
        damping: contact damping; a tensor where derivatives follow it.
    """

    n_particles: int
    n_bands: int
    sources: Tensor
    source_bands: Tensor
    momentum: bool = False
    damping: float | Tensor = 0.0

    @property
    def lossy(self) -> bool:
        """Whether energy is lost, or its loss differentiated."""
        return isinstance(self.damping, Tensor) or self.damping > 0

    @classmethod
    def of_tones(
        cls, n_particles: int, n_bands: int, tones: Sequence[int], momentum: bool = False, damping: float = 0.0
    ) -> Waves:
        """The waves of sources that are tones, counted from 1."""
        number = torch.tensor(tones)
        squares = 4 * torch.sin(math.pi / n_particles * number.double()).square()
        return cls(n_particles, n_bands, squares, (number - 1) // (n_particles // 2 // n_bands), momentum, damping)

    @property
    def ring(self) -> int | Levels:
        """What the site resolvent is summed over."""
        return self.n_particles

    @property
    def tone_squares(self) -> Tensor:
        """w_q^2 of tones 1 to N/2, (tone,)."""
        n = self.n_particles
        return 4 * torch.sin(math.pi / n * torch.arange(1, n // 2 + 1, dtype=torch.float64)).square()

    @property
    def tone_weights(self) -> Tensor:
        """Wavenumbers +-q in a tone: 2, and 1 for the last, (tone,)."""
        weight = torch.full((self.n_particles // 2,), 2.0, dtype=torch.float64)
        weight[-1] = 1.0
        return weight

    @property
    def around(self) -> Tensor:
        """All wavenumbers of the ring, (N,)."""
        return 2 * math.pi / self.n_particles * torch.arange(self.n_particles, dtype=torch.float64)

    @property
    def wavenumbers(self) -> Tensor:
        """Of the sources, (source,)."""
        return 2 * torch.asin(self.sources.sqrt() / 2)

    def banded(self, values: Tensor) -> Tensor:
        """(1/N) sum over a band of w_q^2 times values at the wavenumbers ``around``, even in q: (..., q) to (..., band)."""
        weighted = values[..., 1 : self.n_particles // 2 + 1] * (
            self.tone_squares * self.tone_weights / self.n_particles
        )
        return weighted.reshape(*values.shape[:-1], self.n_bands, -1).sum(-1)

    def received(self, argument: Tensor) -> Tensor:
        """(1/N) sum over a band of w_q^2 / (w_q^2 - e), [band, frequency]; tones one block at a time."""
        n, bands = self.n_particles, self.n_bands
        squares = self.tone_squares.reshape(bands, -1)
        weights = (self.tone_weights / n).reshape(bands, -1)
        found = torch.zeros(bands, len(argument), dtype=argument.dtype)
        size = max(1, 2**21 // (bands * len(argument)))
        for block in range(0, squares.shape[1], size):
            part, weight = squares[:, block : block + size, None], weights[:, block : block + size, None]
            found += (weight * part / (part - argument)).sum(1)
        return found


@dataclass(frozen=True)
class Stretch:
    """One stretch of times and its grid of frequencies."""

    start: float
    stop: float
    eta: float
    step: float
    cut: float
    smooth: float
    points: int


def stretches(last: float, edges: tuple[float, float], decay: float = DECAY, momentum: bool = False) -> list[Stretch]:
    """Stretches that cover times up to ``last`` for a spectrum with these :func:`spectrum_edges`."""
    found: list[Stretch] = []
    start, stop = 0.0, min(FIRST, last) or FIRST
    while True:
        if start == 0:
            cut = max(_FIRST_CUT, 10 * edges[0]) * max(1.0, 1.0 / stop) * (1 + momentum)
            smooth = cut / 5
        else:
            smooth = _SMOOTH / start
            cut = edges[start >= _LATE] + 3.5 * smooth
        period = stop + 1.5 * _SMOOTH / smooth
        step = math.pi / period
        found.append(Stretch(start, stop, decay / period, step, cut, smooth, math.ceil((cut + 4 * smooth) / step)))
        if stop >= last:
            return found
        start, stop = stop, min(stop * RATIO, last)


def spectrum_edges(law: Law) -> tuple[float, float]:
    """Frequencies above which less than shares 3e-7 and 1e-3 of the modes lie."""
    top = 1.1 * 2 / math.sqrt(float(law.values.min()))
    w = torch.linspace(top / 500, top, 500, dtype=torch.float64)
    z = torch.complex(w, torch.full_like(w, 1e-4))
    mass, _ = coherent_mass(z, law)
    density = (2 / math.pi / w) * (z.square() * mass * site_resolvent(z.square() * mass)).imag
    # 1e-4 above the axis every level has a tail of 1e-4 / (pi distance^2), which is no mode there.
    density = (density - 2e-4 / (math.pi * (w - 1).square().clamp(min=0.25))).clamp(min=0)
    beyond = (density * (w[1] - w[0])).flip(0).cumsum(0).flip(0)
    first, late = (float(w[int((beyond > tail).nonzero()[-1])]) for tail in (_TAIL, _LATE_TAIL))
    return first, late


def ladder_transfer(law: Law, waves: Waves, times: Tensor, edges: tuple[float, float], decay: float = DECAY) -> Tensor:
    """Share of each source's energy in each band, [source, time, receiver]."""
    result = torch.zeros(len(waves.sources), len(times), waves.n_bands, dtype=torch.float64)
    for stretch in stretches(float(times[-1]), edges, decay, waves.momentum):
        inside = (times <= stretch.stop) & ((times > stretch.start) | (stretch.start == 0))
        if bool(inside.any()):
            result[:, inside] = _one_stretch(law, waves, times[inside], stretch)
    return result


def _one_stretch(law: Law, waves: Waves, times: Tensor, stretch: Stretch) -> Tensor:
    points = stretch.points
    z, loss, inner, mass, argument = line(law, waves, stretch)
    g = site_resolvent(argument, waves.ring)
    received = waves.received(argument)
    source = 1 / (waves.sources[:, None] - argument)
    window = window_of(z, stretch)
    z, inner = mirrored(z, -1), mirrored(inner, -1)
    mass, g, argument, window, loss = (mirrored(x) for x in (mass, g, argument, window, loss))
    received, source = mirrored(received), mirrored(source)
    coherent = coherent_energy(law, waves, times, stretch, z, source / loss, loss, window)

    # A pair has the mean frequency (n + 1/2) step and the difference 2 m step + 2 i eta; n < 0 mirrors n >= 0.
    differences = 2 * stretch.step * torch.arange(points, dtype=torch.float64)
    low_pass = torch.ones(points, dtype=torch.complex128)
    if stretch.start >= _LATE:  # a Gaussian average of the energy itself: the whole complex difference
        low_pass = torch.exp(
            -(torch.complex(differences, torch.full_like(differences, 2 * stretch.eta)) * _AVERAGE).square() / 2
        )
    used = max(1, int((low_pass.abs() > 1e-9).sum()))
    low_pass[1:] *= 2
    growth = torch.exp(2 * stretch.eta * times)
    pairs = len(waves.sources) * waves.n_bands
    block = min(used, max(1, _BLOCK // pairs))
    spectrum = torch.empty(block, len(waves.sources), waves.n_bands, dtype=torch.complex128)
    energy_in_time = torch.zeros(len(times), pairs, dtype=torch.float64)
    window, inverse, squares = window * math.sqrt(2.0), 1 / z, inner.square()
    own = loss * inverse.square() / 2
    parts = together(squares, squares * g, mass, argument, g, z, inverse, own, source * (window / loss), received)
    below_axis = [x.conj().resolve_conj() for x in parts]
    for m in range(used):
        above, below = slice(points + m, 2 * points), slice(points - m, 2 * (points - m))
        a, flow, mass1, e1, g1, z1, i1, own1, s1, r1 = (x[..., above] for x in parts)
        b, flow2, mass2, e2, g2, z2, i2, own2, s2, r2 = (x[..., below] for x in below_axis)
        vertex, d_argument = a * b * (mass1 - mass2), e1 - e2
        vertex = vertex / ((flow - flow2) - vertex * (g1 - g2) / d_argument)
        energy = (z1 + z2).square() / 2 * i1 * i2 if waves.momentum else own1 + own2 + i1 * i2
        left = s1 * s2 * (vertex * energy / d_argument)
        received_here = r1 - r2
        spectrum[m % block] = left @ received_here.T
        if m % block == block - 1 or m == used - 1:
            some = slice(m - m % block, m + 1)
            angle = differences[some, None] * times
            flat = spectrum[: m % block + 1].reshape(-1, pairs) * low_pass[some, None]
            energy_in_time += angle.cos().T @ flat.real + angle.sin().T @ flat.imag
    energy_in_time *= growth[:, None]
    area = 2 * stretch.step**2 / (2 * math.pi) ** 2
    scale = source_scale(law, waves) * area
    spread = (
        energy_in_time.reshape(len(times), len(waves.sources), waves.n_bands).transpose(0, 1) * scale[:, None, None]
    )
    rows = torch.arange(len(waves.sources))
    spread[rows, :, waves.source_bands] += coherent
    return spread


def together(*tensors: Tensor) -> list[Tensor]:
    """The same, all with a derivative (of zero) where forward mode follows one: it is slow with operands that have none."""
    followed = [forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors]
    if not any(followed):
        return list(tensors)
    return [
        x if has else forward_ad.make_dual(x, torch.zeros_like(x)) for x, has in zip(tensors, followed, strict=True)
    ]


def line(law: Law, waves: Waves, stretch: Stretch) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Frequencies (i + 1/2) step + i eta, (frequency,), those with a negative real part being mirror images; 1 - i damping
    z, by which contact damping multiplies K; the frequency that the chain without damping sees; the medium's mu and e there."""
    right = (torch.arange(stretch.points, dtype=torch.float64) + 0.5) * stretch.step
    z = torch.complex(right, torch.full_like(right, stretch.eta))
    loss = 1 - 1j * waves.damping * z
    inner = z / loss.sqrt()
    mass, _ = coherent_mass(inner, law, waves.ring)
    return z, loss, inner, mass, inner.square() * mass


def source_scale(law: Law, waves: Waves) -> Tensor:
    """The factor of a source before G_k G~_k: w_k^2 for displacements, 1 / < 1/m > for momenta."""
    return torch.full_like(waves.sources, 1 / law.moment(-1)) if waves.momentum else waves.sources


def mirrored(values: Tensor, sign: int = 1) -> Tensor:
    """Values at -z* before those at z: their conjugates (for z itself minus them)."""
    return torch.cat([sign * values.flip(-1).conj(), values], dim=-1)


def fading(times: Tensor, last: float) -> Tensor:
    """1 until half of the last time, 0 from it on, smoothly between, (time,)."""
    gone = (2 * times / last - 1).clamp(0, 1)
    return 1 - gone.square() * (3 - 2 * gone)


def window_of(z: Tensor, stretch: Stretch) -> Tensor:
    """1 on the spectrum, smoothly 0 beyond: in time a kernel narrower than the stretch's distance from 0."""
    at = z.numpy()
    return torch.from_numpy(
        (special.erf((at + stretch.cut) / stretch.smooth) - special.erf((at - stretch.cut) / stretch.smooth)) / 2
    )


def coherent_energy(
    law: Law, waves: Waves, times: Tensor, stretch: Stretch, z: Tensor, mean: Tensor, loss: Tensor, window: Tensor
) -> Tensor:
    """Energy that is still in the source's own wave, [source, time], from the mean amplitudes.

    An oscillator with the mass 1 / < 1/m >, right at high frequency, carries what is not smooth at t = 0.
    """
    squared = waves.sources[:, None]
    mass = 1 / law.moment(-1)
    rest = (mean - 1 / (squared * loss - z.square() * mass)) * window
    wave = torch.exp(-1j * z[:, None] * times) * (stretch.step / (2 * math.pi))
    if stretch.start >= _LATE:  # positive frequencies alone: no products that swing twice as fast
        wave[: len(z) // 2] = 0
    else:
        wave /= 2
    # Complex amplitudes whose real part is the amplitude, the oscillator's first.
    displacement, velocity, momentum = _oscillator(squared, mass, waves.damping, times, waves.momentum)
    if waves.momentum:
        displacement = displacement + 2 * (rest @ wave)
        velocity = velocity + 2 * (-1j * z * rest) @ wave
        momentum = momentum + 2 * (-1j / z * squared * rest) @ wave
    else:
        displacement = displacement + 2 * (-1j / z * squared * rest) @ wave
        velocity = velocity + 2 * (-squared * rest) @ wave
        momentum = momentum + 2 * (-loss / z.square() * squared.square() * rest) @ wave
    if stretch.start >= _LATE:
        potential, kinetic = displacement.abs().square() / 2, (velocity * momentum.conj()).real / 2
    else:
        potential, kinetic = displacement.real.square(), velocity.real * momentum.real
    return (kinetic + squared * potential) * mass if waves.momentum else potential + kinetic / squared


def _oscillator(
    squared: Tensor, mass: float, damping: float | Tensor, times: Tensor, momentum: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Displacement, velocity and momentum of m u'' + d w^2 u' + w^2 u = 0, from u = 1 at rest or from momentum 1 at u = 0.

    The real parts are they; an oscillator that swings has its positive frequency alone.
    """
    half = damping * squared / (2 * mass)
    root = torch.sqrt(torch.complex(half.square() - squared / mass, torch.zeros_like(half)))
    fast, slow = -half + root, -half - root
    apart = fast - slow
    up, down = torch.exp(fast * times), torch.exp(slow * times)
    swings = (root.imag > 0).expand(up.shape)
    if momentum:
        displacement, velocity = (up - down) / apart / mass, (fast * up - slow * down) / apart / mass
        one = [-2 * down / apart / mass, -2 * slow * down / apart / mass]
    else:
        displacement, velocity = (fast * down - slow * up) / apart, fast * slow * (down - up) / apart
        one = [2 * fast * down / apart, 2 * fast * slow * down / apart]
    displacement = torch.where(swings, one[0], displacement)
    velocity = torch.where(swings, one[1], velocity)
    return displacement, velocity, mass * velocity
