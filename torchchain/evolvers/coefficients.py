"""Coefficients of the Chebyshev expansion of the exact motion: Bessel functions and sums of them. Imports Numba.

With z = W t, T_k applied to a state (u, v) enters u(t) and v(t) with

    c_k = 2 J_2k(z),    s_k = (4 / W) (J_2k+1 + J_2k+3 + ...)(z),    d_k = W (J_2k-1 - J_2k+1)(z),

c_0 and s_0 being half of that and d_0 = -W J_1; see :mod:`.stencil`.
"""
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchchain.evolvers.compiling import kernel


@kernel
def bessel_functions(z, values):
    """J_0(z) to J_top(z) by downward recurrence (Miller), normalized by J_0 + 2 J_2 + 2 J_4 + ... = 1.

    The recurrence starts where J is below 1e-25 (see :func:`top_order`), so its start does not show.
    """
    top = values.size - 1
    if z < 1e-6:  # the next terms of the series are below 1e-24
        values[:] = 0.0
        values[0], values[1], values[2] = 1.0 - z * z / 4, z / 2, z * z / 8
        return
    ratio = 2.0 / z
    above, here, norm = 0.0, 1e-280, 0.0
    for order in range(top, 0, -1):
        values[order] = here
        if order % 2 == 0:
            norm += here
        above, here = here, order * ratio * here - above
        if abs(here) > 1e250:
            values[order:] *= 1e-250
            above, here, norm = above * 1e-250, here * 1e-250, norm * 1e-250
    values[0] = here
    values *= 1.0 / (here + 2.0 * norm)


@kernel
def top_order(z):
    """An even order at which J(z) is below 1e-25: by Kapteyn's bound at this distance above z, for any z."""
    return 2 * int(0.5 * z + 8.0 * z ** (1.0 / 3.0) + 10.0)


@kernel
def coefficients(frequency, time, tolerance, bessel, cosine, integral, slope):
    """c_k, s_k and d_k for one time; returns the number of terms.

    Terms are dropped while the sums of |c_k|, W |s_k| and |d_k| / W over all that are dropped stay within the
    tolerance: summed over the Bessel functions themselves, which above the order z are positive and fall faster
    than geometrically. As |T_k| <= 1 on the spectrum, these sums bound the error in the mass norm of W u and of v.
    The number is even and at least four. The first coefficient of each kind is then set so that a
    translation of the whole chain, on which every T_k is 1, moves exactly: c = 1, s = time, d = 0.
    """
    z = frequency * time
    values = bessel[: top_order(z) + 1]
    bessel_functions(z, values)
    terms = 1
    odd = 0.0  # J_2k+1 + J_2k+3 + ...
    dropped_cosine, dropped_integral, dropped_slope = 0.0, 0.0, 0.0
    for k in range(values.size // 2 - 1, 0, -1):
        odd += values[2 * k + 1]
        difference = values[2 * k - 1] - values[2 * k + 1]
        if terms == 1:
            dropped_cosine += 2 * abs(values[2 * k])
            dropped_integral += 4 * abs(odd)
            dropped_slope += abs(difference)
            if max(dropped_cosine, dropped_integral, dropped_slope) > tolerance:
                terms = k + 1
        if k < cosine.size:
            cosine[k] = 2 * values[2 * k]
            integral[k] = 4 * odd / frequency
            slope[k] = frequency * difference
    terms = min(max(4, 2 * ((terms + 1) // 2)), cosine.size)
    rest_cosine, rest_integral, rest_slope = 0.0, 0.0, 0.0
    for k in range(terms - 1, 0, -1):
        rest_cosine += cosine[k]
        rest_integral += integral[k]
        rest_slope += slope[k]
    cosine[0], integral[0], slope[0] = 1.0 - rest_cosine, time - rest_integral, -rest_slope
    return terms


class Tables(NamedTuple):
    """Coefficients for the times of a segment, (time, term)."""

    offsets: np.ndarray  # time after the anchor; -1: none yet
    terms: np.ndarray
    cosine: np.ndarray
    integral: np.ndarray
    slope: np.ndarray
    twice_cosine: np.ndarray
    twice_slope: np.ndarray
    bessel: np.ndarray  # scratch


@kernel
def tabulate(tables, frequency, tolerance, anchor, times, leaps, slack):
    """Fills the tables for these times, or for the first of the leaps to them, unless they hold them already.

    Returns:
        Whether the tables are filled anew.
    """
    known = True
    for j in range(times.size):
        near = slack * times[j] if leaps == 1 else 0.0
        known = known and abs((times[j] - anchor) / leaps - tables.offsets[j]) <= near
    if known:
        return False
    for j in range(times.size):
        offset = (times[j] - anchor) / leaps
        tables.offsets[j] = offset
        tables.terms[j] = coefficients(
            frequency, offset, tolerance, tables.bessel, tables.cosine[j], tables.integral[j], tables.slope[j]
        )
        for k in range(tables.terms[j]):
            tables.twice_cosine[j, k] = 2.0 * tables.cosine[j, k]
            tables.twice_slope[j, k] = 2.0 * tables.slope[j, k]
    return True


def coefficients_of(frequency: np.ndarray, time: np.ndarray, tolerance: float) -> np.ndarray:
    """c_k, s_k and d_k of several chains, zero beyond each one's own number of terms, (3, term, realization).

    Args:
        frequency: W, (realization,).
        time: not negative, (realization,).
        tolerance: largest sum of |c_k|, W |s_k| or |d_k| / W that may be left out.
    """
    size = top_order(float((frequency * time).max())) + 1
    table, bessel, most = np.zeros((len(time), 3, size // 2 + 4)), np.empty(size), 0
    for i, (w, t) in enumerate(zip(frequency, time, strict=True)):
        terms = coefficients(w, t, tolerance, bessel, *table[i])
        table[i, :, terms:] = 0
        most = max(most, terms)
    return table[:, :, :most].transpose(1, 2, 0)
