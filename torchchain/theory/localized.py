"""Energy transfer at infinite time: every frequency keeps its energy, spread over wavenumbers, with localization.

Without interference the energy of source k at frequency w ends in wavenumber q in proportion to the spectral function
A_q(w). In one dimension all modes are localized, and waves that return to k (or -k) interfere: the transfer to q is

    F_q [ 1 + W_kq - c_k - c_q + c ],   F_q = A_q / sum A,   W_kq = C(|k - q|) + C(|k + q|),
    c_k = sum_q F_q W_kq,   c = sum_kq F_k F_q W_kq,

forward and backward scattering alike. C is the Fourier transform of the mean density <|psi(0)|^2 |psi(x)|^2> of localized
modes, which Gogolin (1976) found by Berezinskii's technique, C(0) = 1. Its only length is the mean free path of backward
scattering, l = 1 / Im q for weak disorder. The terms c keep the energy of each frequency, and the symmetry between
source and receiver.

For weak disorder no number is fitted. Beyond it, :class:`Return` holds the numbers measured once over chains: how the
length shortens where it nears one particle, and when the interference sets in.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import scipy
import torch
from torch import Tensor

from torchchain.theory.ladder import Waves
from torchchain.theory.law import Law
from torchchain.theory.medium import coherent_mass, plain, site_resolvent, wavenumber

_LEAVING = 3  # power with which the first crossed scattering gives way
_ABOVE = 1e-8  # the real axis is taken from above, at this distance times the frequency


def density_correlation(x: Tensor) -> Tensor:
    """C(x): Fourier transform of the density of a localized mode about a point of it, x = dk / (2 Im q), C(0) = 1.

    Gogolin's mean density is p(y) = (pi^2 / 16 l) int u sinh(pi u) ((1 + u^2) / (1 + cosh(pi u)))^2
    exp(-(1 + u^2) |y| / 4 l) du with the backward mean free path l = 2 / (2 Im q): a mixture of Lorentzians of half
    widths (1 + u^2) / 8 in x.
    """
    logs, values = _tabulated()
    at = x.abs().clamp(min=math.exp(logs[0]), max=math.exp(logs[-1])).log()
    position = (at - logs[0]) / (logs[1] - logs[0])
    left = position.floor().long().clamp(max=len(values) - 2)
    table = torch.from_numpy(values)
    low, high = table[left], table[left + 1]
    return low + (position - left) * (high - low)


@functools.cache
def _tabulated() -> tuple[np.ndarray, np.ndarray]:
    """C on a grid of log x; its second differences are below 1e-5."""
    u, weight = np.polynomial.legendre.leggauss(200)
    u, weight = 6 * (u + 1), 6 * weight
    mixture = weight * math.pi**2 / 4 * u * np.sinh(math.pi * u) * ((1 + u**2) / (1 + np.cosh(math.pi * u))) ** 2
    width = (1 + u**2) / 8
    mixture = mixture / (4 * 8 * width)  # the weight of a Lorentzian is its share of C(0)
    logs = np.linspace(math.log(1e-4), math.log(1e6), 4000)
    x = np.exp(logs)
    return logs, (mixture / mixture.sum() / (1 + (x[:, None] / width) ** 2)).sum(-1)


@dataclass(frozen=True)
class Return:
    """Numbers of the enhanced return, measured over rings of N = 256, normal masses, xi = 0.1, 0.2, 0.3 and 0.5:
    ``python experiments/measure_return.py`` finds them again, ``most`` aside, which is chosen.

    With a = 2 Im q: C has the argument dk / (a (1 + narrowing a)), and its share exp(-(onset (1 + delay a) / x)^power)
    has come at time t, x = 2 t / t_level, t_level = 2 pi (density of states) / a. Before it stands the crossed scattering of
    two particles (:mod:`torchchain.theory.crossed`), in the part 1 - exp(-(first (1 + delay a) / x)^3) of every frequency,
    and less where it changes shares by ``most`` or more, at which it is no small correction.

    Attributes:
        narrowing, onset, delay, power, first, most: pure numbers.

    Example:
        >>> tc.theory.Return(onset=2.0).onset  # in place of the measured one
        2.0
    """

    narrowing: float = 0.99
    onset: float = 0.98
    delay: float = 3.36
    power: float = 0.98
    first: float = 1.48
    most: float = 0.03


MEASURED = Return()


@dataclass(frozen=True, eq=False)
class Frequencies:
    """The frequencies that one source's energy has, each tensor (node,) but the last.

    Attributes:
        nodes: w.
        energy: share of the source's energy, quadrature weight included; sum 1.
        width: 2 Im q of the coherent wave.
        level_time: 2 pi times the density of states of one localization volume, the time after which levels show.
        receivers: share F_q of each tone at w, (tone, node).
    """

    nodes: Tensor
    energy: Tensor
    width: Tensor
    level_time: Tensor
    receivers: Tensor


def source_frequencies(law: Law, waves: Waves, edge: float, points: int = 4) -> list[Frequencies]:
    """Frequencies of every source: panels that shrink towards its line, so that the narrowest is resolved."""
    medium = _Line(law, edge)
    x, weight = np.polynomial.legendre.leggauss(points)
    squares, weights = waves.tone_squares[:, None], waves.tone_weights[:, None]
    panels = [
        _panels(center, half_width, edge) for center, half_width in zip(*medium.lines(waves.sources), strict=True)
    ]
    nodes = [((edges[1:] + edges[:-1]) / 2, (edges[1:] - edges[:-1]) / 2) for edges in panels]
    frequencies = [torch.from_numpy((middle[:, None] + half[:, None] * x).ravel()) for middle, half in nodes]
    counts = [len(w) for w in frequencies]
    argument, g = medium(torch.cat(frequencies))
    found = []
    for source, w, (_, half), e, density in zip(
        waves.sources.tolist(), frequencies, nodes, argument.split(counts), (argument * g).imag.split(counts), strict=True
    ):  # fmt: skip
        panel = torch.from_numpy((half[:, None] * weight).ravel())
        line = (1 / (source - e)).imag.clamp(min=0) * (w if waves.momentum else 1 / w) * panel
        used = line > 1e-8 * line.sum()
        w, e, line = w[used], e[used], line[used]
        spectral = weights * squares * (1 / (squares - e)).imag.clamp(min=1e-300)
        width = 2 * wavenumber(e).imag
        level_time = 2 * math.pi * (2 / (math.pi * w)) * density[used] / width
        found.append(Frequencies(w, line / line.sum(), width, level_time, spectral / spectral.sum(0)))
    return found


def _panels(center: float, half_width: float, edge: float) -> np.ndarray:
    """Ends of panels from nearly 0 to the edge of the spectrum that shrink towards a line."""
    steps = half_width * 0.25 * 2.0 ** np.arange(60)
    coarse = 0.04 * edge
    steps = steps[steps < coarse]
    steps = np.concatenate([[0.0], steps, np.arange(steps[-1] + coarse if len(steps) else coarse, edge, coarse)])
    lower = edge * 1e-4
    edges = np.unique(np.concatenate([center - steps, center + steps, [lower, edge]]))
    return edges[(edges >= lower) & (edges <= edge)]


class _Line:
    """The medium of the infinite chain on the real axis: solved on a grid, refined at any frequency by Newton steps."""

    def __init__(self, law: Law, edge: float) -> None:
        self.law = law
        band = min(2 / math.sqrt(law.mean), edge / 1.2)
        w = np.unique(np.concatenate([np.linspace(edge * 1e-4, edge, 300), np.linspace(0.8 * band, 1.2 * band, 300)]))
        mass, _ = coherent_mass(self._above(torch.from_numpy(w)), law)
        self._mass = scipy.interpolate.CubicSpline(w, plain(mass).numpy())

    @staticmethod
    def _above(w: Tensor) -> Tensor:
        return torch.complex(w, _ABOVE * w)

    def __call__(self, w: Tensor) -> tuple[Tensor, Tensor]:
        z = self._above(w)
        guess = torch.from_numpy(self._mass(w.numpy()))
        guess = torch.complex(guess.real, guess.imag.clamp(min=1e-14))
        mass, _ = coherent_mass(z, self.law, start=guess)
        argument = z.square() * mass
        return argument, site_resolvent(argument)

    def lines(self, squares: Tensor) -> tuple[list[float], list[float]]:
        """Centers and half widths of the lines of waves with these w_k^2."""
        squared = squares.numpy()
        low, high = np.zeros_like(squared), np.full_like(squared, self._mass.x[-1])
        for _ in range(60):
            center = (low + high) / 2
            below = center**2 * self._mass(center).real < squared
            low, high = np.where(below, center, low), np.where(below, high, center)
        argument, _ = self(torch.from_numpy(center))
        half_width = (argument.imag.abs() / (2 * torch.from_numpy(center))).clamp(min=1e-10)
        return center.tolist(), half_width.tolist()


def interference(waves: Waves, wavenumber: float, spectrum: Frequencies, numbers: Return = MEASURED) -> Tensor:
    """W_kq - c_k - c_q + c for the source's wavenumber k and every receiving tone, (tone, node)."""
    n = waves.n_particles
    around = 2 * math.pi / n * torch.arange(n // 2 + 1, dtype=torch.float64)
    width = spectrum.width * (1 + numbers.narrowing * spectrum.width)
    # Distances on the ring 0, ..., N/2, mirrored.
    kernel = density_correlation(around[:, None] / width)
    whole = torch.zeros(n // 2 + 1, len(spectrum.nodes), dtype=torch.float64)
    whole[1:] = spectrum.receivers
    whole[1:-1] /= 2
    mean = 2 * _even_convolution(whole, kernel, n)[1:]
    q = around[1:, None]
    far = torch.minimum(wavenumber + q, 2 * math.pi - wavenumber - q)
    pair = density_correlation((wavenumber - q).abs() / width) + density_correlation(far / width)
    own = (spectrum.receivers * pair).sum(0)
    return pair - own - mean + (spectrum.receivers * mean).sum(0)


def onset(times: Tensor, spectrum: Frequencies, numbers: Return = MEASURED) -> Tensor:
    """Share of the interference that has come by each time, (node, time); 0 at t = 0, 1 for ever."""
    return torch.exp(-((numbers.onset * _lateness(times, spectrum, numbers)) ** numbers.power))


def first_part(times: Tensor, spectrum: Frequencies, numbers: Return = MEASURED) -> Tensor:
    """Part of the source's energy whose interference is still that of two particles, (time,); 1 at t = 0, 0 for ever."""
    return -torch.expm1(-((numbers.first * _lateness(times, spectrum, numbers)) ** _LEAVING)).T @ spectrum.energy


def _lateness(times: Tensor, spectrum: Frequencies, numbers: Return) -> Tensor:
    """(1 + delay a) / x, (node, time)."""
    x = 2 * times / spectrum.level_time[:, None]
    return (1 + numbers.delay * spectrum.width[:, None]) / x.clamp(min=1e-9)


def _even_convolution(a: Tensor, b: Tensor, n: int) -> Tensor:
    """Circular convolution of two even sequences of period n given on 0..n/2."""
    both = torch.stack([a, b])
    whole = torch.cat([both, both[:, 1:-1].flip(1)], dim=1)
    image = torch.fft.rfft(whole, dim=1)
    return torch.fft.irfft(image[0] * image[1], n, dim=0)[: n // 2 + 1]
