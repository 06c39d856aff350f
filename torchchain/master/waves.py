"""Waves of an effective medium, and the odds that one has scattered into another: perturbation theory, damped.

A wave of frequency w and decay g scatters into one of w', g' with the odds

    D = c w w' (h(w - w') - h(w + w')),   h(x) = (1 - exp(-G t) (cos x t + G sin(x t) / x)) / (x^2 + G^2),   G = g + g',

which start as t^4 and end as a Lorentzian. w and g are those of the self-consistent Born approximation.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene

FLOOR = 0.05
"""The odds' first guess stays above this share of its envelope: where waves have beaten to rest, others have come."""
TONES = 8
"""Tones of a receiving band that are summed over; of more, as many spread evenly."""
SERIES = 0.1
"""Up to this time D is summed in powers of t, beyond as it stands: differences of cosines lose digits at first."""
SERIES_ORDER = 14
LARGEST_KEPT, MOST_KEPT = 2**21, 8
"""Numbers behind an answer of :func:`first_odds` that is kept, and such answers."""
WIDTH = 0.8
"""Decay rates in D, relative to the Born approximation's: with the distance in these units the rest is smoothest."""

_kept: dict[tuple[Any, ...], Tensor] = {}


@dataclass(frozen=True, eq=False)
class Waves:
    """The waves of an effective medium: frequencies and decay rates of amplitudes, per unit time.

    Attributes:
        source_frequency, source_decay: of the tone of each source, (band,).
        tone_frequency, tone_decay: of tones in each receiving band, (band, tone).
        coupling: c, the variance of the disorder for each tone.
    """

    source_frequency: Tensor
    source_decay: Tensor
    tone_frequency: Tensor
    tone_decay: Tensor
    coupling: Tensor

    @classmethod
    def of(cls, scene: Scene) -> Waves:
        """The waves of a scene's chains, with one tone in each band, in the self-consistent Born approximation."""
        strength = checks.number("strength", whole_strength(scene), above=0)
        return _of(scene.n_particles, scene.n_bands, tuple(scene.tones), strength)

    def tensors(self) -> dict[str, Tensor]:
        return dict(vars(self))

    @property
    def distances(self) -> Tensor:
        """Logarithms of those between frequencies in units of the decays, from 0 for the nearest bands to 1, [source, receiver]."""
        n = len(self.source_frequency)
        off = ~torch.eye(n, dtype=torch.bool, device=self.source_frequency.device)
        far = (self.tone_frequency.mean(1) - self.source_frequency[:, None]).abs()
        far = torch.asinh(far / (self.source_decay[:, None] + self.tone_decay.mean(1)))
        low, high = (far[off].min(), far[off].max()) if n > 1 else (far.min(), far.max())
        return ((far - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)


def whole_strength(scene: Scene) -> float:
    """Standard deviation of the masses, and of the contacts if they vary too."""
    other = scene.stiffness_disorder
    return math.hypot(scene.disorder.strength, 0.0 if other is None else other.strength)


@functools.lru_cache(maxsize=16)
def _of(n: int, bands: int, numbers: tuple[int, ...], strength: float) -> Waves:
    width = n // 2 // bands
    inside = np.arange(width) if width <= TONES else (np.arange(TONES) + 0.5) * width / TONES - 0.5
    tones = np.arange(bands)[:, None] * width + inside + 1
    source = poles(2 * np.sin(np.pi / n * np.array(numbers, dtype=float)), strength)
    receiver = poles(2 * np.sin(np.pi / n * tones), strength)
    coupling = strength**2 / n * width / len(inside)
    found = (source.real, -WIDTH * source.imag, receiver.real, -WIDTH * receiver.imag)
    frequency, decay, others, other_decay = (torch.from_numpy(value.copy()) for value in found)
    return Waves(frequency, decay, others, other_decay, torch.tensor(coupling, dtype=torch.float64))


def poles(frequency: np.ndarray, strength: float) -> np.ndarray:
    """Complex frequencies z = w / sqrt(mu(Re z)) of waves of the ordered chain's frequency w, imaginary parts below 0.

    The effective mass mu = 1 + xi^2 z^2 g with the local response g = 1 / sqrt(e (e - 4)), e = z^2 mu, Im g > 0, of the
    infinite chain; by damped iteration. In weak disorder -Im z = xi^2 sin(k/2) tan(k/2), half of Born's decay rate.
    """
    z, mu = frequency + 0j, np.full(frequency.shape, 1 + 1e-3j)
    for _ in range(400):
        squared = z.real**2
        g = 1 / np.sqrt(squared * mu * (squared * mu - 4))
        mu = 0.6 * mu + 0.4 * (1 + strength**2 * squared * np.where(g.imag < 0, -g, g))
        z = 0.6 * z + 0.4 * frequency / np.sqrt(mu)
    return np.where(z.imag > 0, z.conj(), z)


def first_odds(waves: Waves, times: Tensor, sources: Tensor) -> Tensor:
    """D [source, time, receiver], positive, of some sources; times may be infinite.

    Models of one ensemble are asked for the same times again and again: the latest answers are kept.
    """
    given = (*waves.tensors().values(), times, sources)
    size = len(sources) * len(times) * waves.tone_frequency.numel()
    if size > LARGEST_KEPT or any(value.requires_grad or value.device.type != "cpu" for value in given):
        return _odds(waves, times, sources)
    try:
        key = tuple((value.dtype, tuple(value.shape), value.detach().numpy().tobytes()) for value in given)
    except RuntimeError:  # inside torch.func's transforms no number has a value of its own
        return _odds(waves, times, sources)
    if key not in _kept:
        while len(_kept) >= MOST_KEPT:
            _kept.pop(next(iter(_kept)), None)
        _kept[key] = _odds(waves, times, sources)
    return _kept[key]


def all_odds(waves: Waves, times: Tensor, sources: Tensor) -> tuple[Tensor, Tensor]:
    """:func:`first_odds` with 1 for the source's own band, and which band that is, 1 for it and else 0, [source, 1, receiver]."""
    odds = first_odds(waves, times, sources)
    own = torch.nn.functional.one_hot(sources, odds.shape[-1]).to(odds)[:, None]
    return odds * (1 - own) + own, own


def _odds(waves: Waves, times: Tensor, sources: Tensor) -> Tensor:
    w, g = waves.source_frequency[sources][:, None, None, None], waves.source_decay[sources][:, None, None, None]
    other, decay = waves.tone_frequency[:, :, None], waves.tone_decay[:, :, None]  # [receiver, tone, time]
    return (waves.coupling * scattered(w, other, g + decay, times)).sum(2).transpose(1, 2)


def scattered(w: Tensor, other: Tensor, rate: Tensor, times: Tensor, kicked: bool = False) -> Tensor:
    """D over c, positive, (..., time), of waves of frequency w, released at rest, or kicked, into those of another.

    The odds after a kick are c w^2 (h(w - w') + h(w + w')), which start as t^2.

    Args:
        w, other, rate: frequencies, and the sum of both decays, (..., 1).
        times: (time,), may be infinite.
        kicked: whether the wave began as one of velocity.
    """
    slow, fast, finite = (w - other).abs(), w + other, times.isfinite()
    t = torch.where(finite, times, torch.zeros_like(times))
    near, far = _response(slow, rate, t), _response(fast, rate, t)
    last_near, last_far = 1 / (slow**2 + rate**2), 1 / (fast**2 + rate**2)
    squared = t**2
    settled = 1 + squared * (slow**2 + rate**2) / 2
    if kicked:  # t^2 at first, and two Lorentzians in the end
        size, beat, late = w * w, near + far, last_near + last_far
        rise, ending = squared / settled, late
    else:  # t^4 w w' / 6 at first, and a Lorentzian in the end
        size, late = w * other, last_near - last_far
        beat, first = near - far, finite & (t < SERIES)
        if bool(first.any()):
            beat[..., first] = _early(slow, fast, rate, t[first])
        rise = squared**2 * w * other / 6 / ((1 + squared * fast**2 / 12) * settled)
        ending = 4 * w * other / (fast**2 * (slow**2 + rate**2))
    beat = torch.where(finite, beat, late)
    least = FLOOR * torch.where(finite, rise, ending)
    return size * (beat + (beat**2 + 4 * least**2).sqrt()) / 2


def _response(x: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """h(x): what obeys h'' + 2 G h' + (G^2 + x^2) h = 1 from rest."""
    return (1 - torch.exp(-rate * t) * (torch.cos(x * t) + rate * t * torch.sinc(x * t / math.pi))) / (x**2 + rate**2)


def _early(slow: Tensor, fast: Tensor, rate: Tensor, t: Tensor) -> Tensor:
    """h(slow) - h(fast) in powers of t from t^4, where the two begin to differ."""
    result = torch.zeros_like(slow * t)
    pairs = []
    for x in (slow, fast):
        derivatives = [torch.ones_like(x * rate), -2 * rate + 0 * x]
        for _ in range(4, SERIES_ORDER + 1):
            derivatives.append(-2 * rate * derivatives[-1] - (rate**2 + x**2) * derivatives[-2])
        pairs.append(derivatives)
    for order in range(4, SERIES_ORDER + 1):
        result = result + (pairs[0][order - 2] - pairs[1][order - 2]) * t**order / math.factorial(order)
    return result
