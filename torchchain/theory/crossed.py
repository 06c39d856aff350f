"""What crossed scattering by two particles adds to the ladder, to first order and exactly conserving.

The ladder follows both amplitudes through the same particles in the same order. To fourth order in the disorder it lacks
the diagrams in which two different particles a and b are visited crosswise: a, b, a, b in one amplitude (a self-energy);
a, b in one and b, a in the other (the first crossed diagram of enhanced backscattering); a, b, a in one and b in the other.
With the amplitude g_r between particles at a distance r, and V = z^2 (m - < m >) of variance z^4 s,

    S_k = z^8 s^2 sum_(r != 0) g_r^3 cos kr,
    W_kq = s^2 z^2 z~^2 sum_(r != 0) (z^2 z~^2 g_r g~_r + z^4 g_r^2 + z~^4 g~_r^2) cos kr cos qr,

the last averaged over +-q. The coherent potential answers to S by z^2 d_mu = L d_g, d_g = (1/N) sum_q G_q^2 (S_q + z^2 d_mu), L its own
vertex at z~ = z; so do the ladder's vertex and W, in which that answer is the term r = 0. Then for every pair

    (1/N) sum_q W_kq (z^2 G_q - z~^2 G~_q) = z~^2 S_k - z^2 S~_k - (1/A) (z^2 d_g - z~^2 d_g~),    1/A the ladder's vertex,

which is what keeps the energy. Both go into the ladder once: < GG~ > changes by F (W + S G + S~ G~) F, F the ladder's own.
Right to fourth order in the disorder, so at early times; infinitely late it stays finite, but loops of more particles are missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from torchchain.theory.ladder import (
    DECAY,
    Stretch,
    Waves,
    coherent_energy,
    line,
    mirrored,
    source_scale,
    together,
    window_of,
)
from torchchain.theory.law import Law
from torchchain.theory.medium import site_resolvent

LAST = 48.0
"""Time up to which the correction is computed."""
_FARTHEST = 10  # particles between a and b: farther ones meet later than LAST or hardly at all
_BEYOND, _SMOOTH = 1.0, 0.6  # the spectrum's window ends this far beyond its edge, over this width


@dataclass(frozen=True)
class _Side:
    """One resolvent at every frequency, and its sums over wavenumbers, each tensor (frequency, ...).

    Attributes:
        z, squared, loss: frequency, its square without contact damping, 1 - i damping z.
        mass, argument, g: the medium's mu, e = z^2 mu and (1/N) sum_q G_q.
        apart: (1/N) sum_q G_q cos qr, (..., r) from r = 0.
        self_energy: S as coefficients of cos kr, (..., r), with the medium's answer at r = 0.
        shift, mass_shift: d_g and d_mu of that answer.
        bands: (1/N) sum_(q in band) w_q^2 G_q cos qr, (..., r, band).
        band_twice, twice: sums of G_q^2 S_q with w_q^2 in a band, and over all q.
        source, source_self: G_k and G_k S_k of the sources, (..., source).
        window: of the spectrum.
    """

    z: Tensor
    squared: Tensor
    loss: Tensor
    mass: Tensor
    argument: Tensor
    g: Tensor
    apart: Tensor
    self_energy: Tensor
    shift: Tensor
    mass_shift: Tensor
    bands: Tensor
    band_twice: Tensor
    twice: Tensor
    source: Tensor
    source_self: Tensor
    window: Tensor

    def part(self, some: slice, conjugate: bool) -> _Side:
        """Some frequencies; on the line below the axis where conjugated."""
        parts = (getattr(self, f.name)[some] for f in fields(self))
        return _Side(*(x.conj().resolve_conj() if conjugate else x for x in parts))


def crossed_transfer(law: Law, waves: Waves, times: Tensor, edge: float) -> tuple[Tensor, Tensor]:
    """What crossed scattering adds to the ladder's shares, [source, time, band], rows adding up to 0, and what of it is the mean wave's,
    [source, time].

    Args:
        law: of the masses.
        waves: of a ring.
        times: (time,), up to LAST.
        edge: of the spectrum.
    """
    last = max(float(times[-1]), 4.0)
    period = last + 6 / _SMOOTH
    cut, step = edge + _BEYOND, math.pi / period
    stretch = Stretch(0.0, last, DECAY / period, step, cut, _SMOOTH, math.ceil((cut + 4 * _SMOOTH) / step))
    side, means = _side(law, waves, stretch)
    points, bands = stretch.points, waves.n_bands
    *parts, coskr = together(
        *(getattr(side, f.name) for f in fields(side)), _cosines(waves.wavenumbers, side.apart.shape[1])
    )
    side = _Side(*parts)
    spectrum = torch.empty(points, len(waves.sources) * bands, dtype=torch.complex128)
    for m in range(points):
        above = side.part(slice(points + m, 2 * points), False)
        below = side.part(slice(points - m, 2 * (points - m)), True)
        spectrum[m] = _pairs(law, waves, above, below, coskr).reshape(-1)
    spectrum[1:] *= 2
    angle = 2 * stretch.step * torch.arange(points, dtype=torch.float64)[:, None] * times
    found = (angle.cos().T @ spectrum.real + angle.sin().T @ spectrum.imag) * torch.exp(2 * stretch.eta * times)[
        :, None
    ]
    found = found.reshape(len(times), len(waves.sources), bands).transpose(0, 1)
    found = found * (4 * stretch.step**2 / (2 * math.pi) ** 2 * source_scale(law, waves))[:, None, None]
    # The coherent energy is quadratic in the mean amplitudes: half the difference of both signs is its linear change.
    more, less = (coherent_energy(law, waves, times, stretch, side.z, mean, side.loss, side.window) for mean in means)
    coherent = (more - less) / 2
    found[torch.arange(len(found)), :, waves.source_bands] += coherent
    begun = times > 0  # nothing has been scattered at t = 0, which wide spectra miss by 2e-5
    return found * begun[:, None], coherent * begun


def _variance(law: Law, waves: Waves) -> Tensor:
    """s: of the masses; for random stiffnesses theirs, over their mean squared, in place of the skew compliances'."""
    values = 1 / law.values if waves.momentum else law.values
    mean = law.weights @ values
    variance = law.weights @ (values - mean).square()
    return variance / mean.square() if waves.momentum else variance


def _cosines(wavenumbers: Tensor, count: int) -> Tensor:
    """cos kr, (wavenumber, r)."""
    return torch.cos(wavenumbers[:, None] * torch.arange(count, dtype=torch.float64)).to(torch.complex128)


def _side(law: Law, waves: Waves, stretch: Stretch) -> tuple[_Side, list[Tensor]]:
    """The resolvent on the whole line, and the sources' mean amplitudes with plus and minus their change."""
    z, loss, inner, mass, argument = line(law, waves, stretch)
    squared = inner.square()
    g = site_resolvent(argument, waves.ring)
    count = min(_FARTHEST, (waves.n_particles - 1) // 2) + 1
    cosines = _cosines(waves.around, count)
    resolvents = 1 / (4 * torch.sin(waves.around / 2).square() - argument[:, None])  # (frequency, q)
    apart = resolvents @ cosines / waves.n_particles
    potential = squared[:, None] * (law.values - mass[:, None])
    scattered = (potential / (1 - potential * g[:, None])).square() @ law.weights.to(potential)
    vertex = scattered / (1 + scattered * g.square())
    self_energy = 2 * _variance(law, waves) ** 2 * squared[:, None] ** 4 * apart**3
    self_energy[:, 0] = 0
    twice = resolvents.square()
    shift = (twice * (self_energy @ cosines.T)).mean(1) / (1 - vertex * twice.mean(1))
    self_energy[:, 0] = vertex * shift
    of_q = self_energy @ cosines.T
    twice = twice * of_q
    bands = torch.stack([waves.banded(resolvents * cosine) for cosine in cosines.T], dim=1)
    source = 1 / (waves.sources - argument[:, None])
    source_self = source * (self_energy @ _cosines(waves.wavenumbers, count).T)
    parts = [
        squared, loss, mass, argument, g, apart, self_energy, shift, vertex * shift / squared, bands, waves.banded(twice),
        twice.mean(1), source, source_self,
    ]  # fmt: skip
    whole = [mirrored(part.movedim(0, -1)).movedim(-1, 0) for part in parts]
    z = mirrored(z, -1)
    side = _Side(*[z, *whole, window_of(z, stretch)])
    change = side.source * side.source_self
    means = [((side.source + sign * change) / side.loss[:, None]).T for sign in (1, -1)]
    return side, means


def _pairs(law: Law, waves: Waves, one: _Side, two: _Side, coskr: Tensor) -> Tensor:
    """Sum over all mean frequencies of one difference, [source, band]."""
    squares = one.squared * two.squared
    d_mass, d_argument = one.mass - two.mass, one.argument - two.argument
    flow = one.squared * one.g - two.squared * two.g
    inverse = flow / (squares * d_mass)  # A
    ladder = 1 / (inverse - (one.g - two.g) / d_argument)  # X
    answer = (one.squared * one.shift - two.squared * two.shift) / (squares * d_mass)
    answer = answer - inverse * (one.mass_shift - two.mass_shift) / d_mass
    a, b, product = one.squared[:, None], two.squared[:, None], squares[:, None]
    crossed = product * one.apart * two.apart + (a * one.apart).square() + (b * two.apart).square()
    crossed = 2 * _variance(law, waves) ** 2 * product * crossed
    crossed[:, 0] = -answer / inverse.square()
    apart = (one.apart - two.apart) / d_argument[:, None]
    bands = (one.bands - two.bands) / d_argument[:, None, None]
    band = bands[:, 0]
    if waves.momentum:
        energy = (one.z + two.z).square() / (2 * one.z * two.z)
    else:
        energy = (one.loss / one.z.square() + two.loss / two.z.square()) / 2 + 1 / (one.z * two.z)
    weight = one.window * two.window * energy / (one.loss * two.loss)

    # The self-energies': sums of D_q (S G_q + S~ G~_q), D = G G~, over a band and over all q.
    def rest(side: _Side) -> tuple[Tensor, Tensor]:
        inside = torch.einsum("pr,prb->pb", side.self_energy, bands)
        return side.band_twice - inside, side.twice - (side.self_energy * apart).sum(1)

    (band_one, all_one), (band_two, all_two) = rest(one), rest(two)
    own = ((all_one - all_two) / d_argument * ladder)[:, None]
    return_band = (band_one - band_two) / d_argument[:, None] + own * band
    source = one.source * two.source * weight[:, None]
    left = source[:, :, None] * (coskr + (ladder[:, None] * apart)[:, None])
    right = crossed[:, :, None] * (bands + (ladder[:, None] * apart)[:, :, None] * band[:, None])
    found = left.transpose(0, 1).reshape(len(coskr), -1) @ right.reshape(-1, band.shape[1])
    found = found + (source * (one.source_self + two.source_self) * ladder[:, None]).T @ band
    return found + (source * ladder[:, None]).T @ return_band
