"""Coefficients of the Chebyshev expansion of the exact motion, and how it is cut into segments of time."""

from __future__ import annotations

import math

import numpy as np

# A stretch of time with z beyond this is crossed in equal leaps. Longer ones save little, as the degree is z / 2 and a
# few, while rounding errors of the recursion grow with its degree.
LEAP = 256.0
# The outputs that follow a state until z exceeds REACH, at most LONGEST, share the kernels' recursion: the work per
# output, degree(z) stencils for all of them plus two sums each, is flat around this minimum.
REACH = 24.0
LONGEST = 8
SEGMENTS = 1024
ROUNDING = 2.0**-53


def coefficients(frequency: np.ndarray, time: np.ndarray, tolerance: float) -> np.ndarray:
    """Coefficients of T_k in the cosine, its time integral and its time derivative, (3, term, realization).

    They are 2 J_2k(z), (4 / W) (J_2k+1 + J_2k+3 + ...)(z) and W (J_2k-1 - J_2k+1)(z) with z = W t, half of that for
    k = 0. Each realization has as many terms as its z needs and zeros beyond: the sums of all |cosine|, W |integral|
    and |derivative| / W left out are within the tolerance. The first term is set so that a translation of the whole
    chain, on which every T_k is 1, moves exactly: the sums over k are 1, t and 0.

    Args:
        frequency: W, (realization,).
        time: t, not negative, (realization,).
        tolerance: see above.
    """
    z = frequency * time
    bessel = _bessel(z)
    even, odd = bessel[0::2], bessel[1::2]
    before = np.concatenate([-odd[:1], odd[:-1]])  # J_-1 = -J_1
    odd_sums = np.cumsum(odd[::-1], axis=0)[::-1]
    table = np.stack([2 * even, 4 * odd_sums / frequency, frequency * (before - odd)])
    table[:, 0] /= 2
    sizes = np.abs(table) * np.stack([np.ones_like(z), frequency, 1 / frequency])[:, None]
    left_out = np.cumsum(sizes[:, ::-1], axis=1)[:, ::-1].max(0)
    table = np.where(left_out > tolerance, table, 0.0)
    rest = np.cumsum(table[:, :0:-1], axis=1)[:, -1]  # in the same order in any batch, unlike a sum
    table[:, 0] = np.stack([np.ones_like(z), time, np.zeros_like(z)]) - rest
    return table[:, : (left_out > tolerance).sum(0).max()]


def _bessel(z: np.ndarray) -> np.ndarray:
    """J_0 to an odd order of each z by downward recurrence (Miller), (order, realization), good to 2e-16.

    (SciPy's values are good to 4e-15 at z = 256, and some hundred are summed.) The recurrence starts where J is below
    1e-25 by Kapteyn's inequality (DLMF, Section 10.14), at its own order for each z so that a batch does not matter, and
    J_0 + 2 J_2 + 2 J_4 + ... = 1 gives the factor.
    """
    tiny = z < 1e-6
    top = 2 * (0.5 * z + 8.0 * np.cbrt(z) + 10.0).astype(int)
    ratio = 2 / np.where(tiny, 1.0, z)
    values = np.zeros((top.max() + 2, len(z)))
    above, here, norm = np.zeros((3, len(z)))
    for order in range(top.max(), 0, -1):
        here = np.where(order == top, 1e-280, here)
        values[order] = here
        norm = norm + 2 * here if order % 2 == 0 else norm
        above, here = here, order * ratio * here - above
    values[0] = here
    values /= here + norm
    series = np.zeros_like(values)
    series[:3] = 1 - z * z / 4, z / 2, z * z / 8  # the next terms are below 1e-18 of the size of these
    return np.where(tiny, series, values)


def terms(z: float, accuracy: float) -> float:
    """Chebyshev terms for a phase z: J_2k(z) falls below the accuracy / 1024 some Airy widths beyond 2k = z."""
    depth = (1.5 * math.log(1024 / accuracy)) ** (2 / 3)
    return 2 * math.ceil((0.5 * (z + depth * (z / 2) ** (1 / 3)) + 1) / 2)
