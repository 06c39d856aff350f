"""Ringing of clusters of light particles, for the correction of the theory where masses have few values.

Between heavy particles the same clusters of light ones stand all along the chain and ring at frequencies W of their own: a wave
of frequency w_s that has scattered into them beats with W - w_s, in its own band and in those that it has come to. What the theory says of
this in the mean wave, but not of what has been scattered, is left to a sum in the exponent of a pair of bands,

    sum_W  exp(-g t) (1 - exp(-(t / t1)^2)) [ c_W(s, r) cos (W - w_s) t + d_W(s, r) sin (W - w_s) t ]  +  (s <-> r),

for T is nearly reciprocal. c and d are polynomials of both places; the frequencies are no fitted numbers but a comb from below the heavy
particles' own spectrum's end to the light ones', as narrow as the decay g is wide: no cluster rings outside.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.logistic import RIDGE, Regression
from torchchain.master.polynomials import LARGEST_EXPONENT, checked_degrees, n_coefficients, polynomials
from torchchain.master.theory_rings import Ring

DECAY, RISE = 0.15, 2.0
"""g, per unit time, and t1: chosen on chains of xi = 0.5 and 0.7."""
LOWEST = 0.6
"""Of the comb, over the end of a chain of the heaviest particles alone."""
MOST_FREQUENCIES = 40

Degrees = tuple[int, ...]
"""In place, distance and time; where clusters ring, in both places and how many frequencies, too."""


def checked_ringing(degrees: Any) -> Degrees:
    """Five degrees of a correction that rings."""
    if not isinstance(degrees, (tuple, list)) or len(degrees) != 5:
        raise checks.fail("degrees", "be five integers for model 'ringing_theory'", degrees)
    degree = checks.integer("degrees", degrees[3], 0, 20)
    return (*checked_degrees(degrees[:3]), degree, checks.integer("degrees", degrees[4], 1, MOST_FREQUENCIES))


def smooth_of(degrees: Degrees) -> tuple[int, int, int]:
    """Those in place, distance and time."""
    place, distance, time = degrees[:3]
    return place, distance, time


def size_of(degrees: Degrees) -> int:
    """Coefficients of a correction; they do not depend on the number of bands."""
    return n_coefficients(degrees[:3]) + (2 * degrees[4] * len(products(degrees[3])) if len(degrees) == 5 else 0)


def products(degree: int) -> list[tuple[int, int]]:
    """Degrees in the place whose wave beats and in the other one."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


@dataclass(frozen=True)
class Ringing:
    """The beats of a ring's bands with its clusters.

    Attributes:
        clusters: W, (frequency,).
        waves: w, of the tone of each band, (band,).
        degree: of c and d.
    """

    clusters: tuple[float, ...]
    waves: tuple[float, ...]
    degree: int

    @classmethod
    def of(cls, ring: Ring, degree: int, count: int) -> Ringing:
        """Of a ring's law, with so many frequencies."""
        low, high = 2 * LOWEST / math.sqrt(max(ring.values)), 2 / math.sqrt(min(ring.values))
        waves = 2 * np.sin(np.pi / ring.n_particles * np.array(ring.tones, dtype=float))
        return cls(tuple(np.linspace(low, high, count).tolist()), tuple(waves.tolist()), degree)

    def _beats(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """Cosines, then sines, of each frequency, (beat, band, time), and polynomials of place, (band, degree)."""
        times = times.double()
        finite = torch.where(times.isfinite(), times, torch.zeros_like(times))  # nothing rings at 0 and at infinity
        clusters, waves = (times.new_tensor(each) for each in (self.clusters, self.waves))
        phase = (clusters[:, None] - waves)[..., None] * finite
        fading = torch.exp(-DECAY * finite) * -torch.expm1(-((finite / RISE) ** 2))
        beats = torch.cat([phase.cos(), phase.sin()]) * fading
        place = torch.arange(len(waves), dtype=times.dtype, device=times.device) / max(len(waves) - 1, 1)
        return beats, polynomials(place, max(self.degree, 1))

    def exponent(self, times: Tensor, coefficients: Tensor) -> Tensor:
        """Of the factor of each pair, [source, time, receiver], from coefficients by beat and product, (term,)."""
        beats, place = self._beats(times)
        beats, place = beats.to(coefficients), place.to(coefficients)
        i, j = (torch.tensor(each, device=coefficients.device) for each in zip(*products(self.degree), strict=True))
        table = coefficients.new_zeros(len(beats), place.shape[1], place.shape[1])
        table[:, i, j] = coefficients.reshape(len(beats), -1)
        one = torch.einsum("fst,si,fij,rj->str", beats, place, table, place)
        return (one + one.transpose(0, 2)).clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT)

    def slopes(self, times: Tensor) -> Iterator[np.ndarray]:
        """Of the exponent by its coefficients, [source, receiver, term], at one time after the other.

        Of all at once there would be hundreds of megabytes.
        """
        beats, place = (each.numpy() for each in self._beats(times))
        own, other = (place[:, list(each)] for each in zip(*products(self.degree), strict=True))
        for beat in beats.transpose(2, 1, 0):
            parts = beat[:, :, None] * own[:, None]  # (source, beat, product)
            found = (parts[:, None] * other[:, None]).reshape(len(own), len(own), -1)
            yield found + found.transpose(1, 0, 2)


@dataclass(frozen=True, eq=False)
class RingingRegression(Regression):
    """A regression whose exponents ring: its coefficients are the polynomials', then the ringing's, and no table.

    Attributes:
        ringing: see :class:`Ringing`.
        when: times of the data, some of which may be infinite, (time,).
    """

    ringing: Ringing
    when: Tensor

    @property
    def size(self) -> int:
        return super().size + 2 * len(self.ringing.clusters) * len(products(self.ringing.degree))

    def table(self, held: np.ndarray) -> np.ndarray:
        return held

    def predicted(self, coefficients: np.ndarray) -> np.ndarray:
        first = super().size
        smooth = self.shape @ (super().table(coefficients[:first]) @ self.clock.T)
        rings = self.ringing.exponent(self.when, torch.from_numpy(coefficients[first:])).numpy()
        moved = self.odds * np.exp(np.clip(smooth, -LARGEST_EXPONENT, LARGEST_EXPONENT).transpose(0, 2, 1) + rings)
        return moved / moved.sum(-1, keepdims=True)

    def normal(self, found: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        matrix, pull = RIDGE * np.eye(self.size), -RIDGE * coefficients
        for i, slope in enumerate(self._slopes(found)):
            matrix += slope.T @ slope
            pull += slope.T @ ((self.data[:, i] - found[:, i]) * self.weight[:, i, None]).ravel()
        return matrix, pull

    def pull(self, found: np.ndarray, missed: np.ndarray) -> np.ndarray:
        result = np.zeros((*missed.shape[:-3], self.size))
        for i, slope in enumerate(self._slopes(found)):
            part = missed[..., i, :] * self.weight[:, i, None]
            result += part.reshape(*part.shape[:-2], -1) @ slope
        return result

    def _slopes(self, found: np.ndarray) -> Iterator[np.ndarray]:
        """Derivatives of T by the coefficients, over its error, (source receiver, term), of one time after the other."""
        rows, columns = np.nonzero(self.held)
        for i, (clock, rings) in enumerate(zip(self.clock, self.ringing.slopes(self.when), strict=True)):
            exponent = np.concatenate([self.shape[..., rows] * clock[columns], rings], axis=-1)
            mean = np.matmul(found[:, None, i], exponent)
            slope = (exponent - mean) * (found[:, i] * self.weight[:, i, None])[..., None]
            yield slope.reshape(-1, exponent.shape[-1])
