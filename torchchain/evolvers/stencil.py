"""Chebyshev propagation with one chain kept in cache: the Numba kernels behind :mod:`chebyshev` and :mod:`torchchain.fused`.

A state at time t is a sum of Chebyshev polynomials T_k(x) of x = 1 - 2 A / W^2, A = -M^-1 K, applied to the state
(u, v) at an earlier *anchor*:

    u(t) = sum_k [c_k T_k u + s_k T_k v],    v(t) = sum_k [c_k T_k v + d_k T_k u],

with z = W (t - anchor) and

    c_k = 2 J_2k(z),    s_k = (4 / W) (J_2k+1 + J_2k+3 + ...)(z),    d_k = W (J_2k-1 - J_2k+1)(z),

c_0 and s_0 being half of that and d_0 = -W J_1. The outputs that follow an anchor closely form one *segment* and
share its T_k; the last of them is the next anchor.

On a uniform time grid the states mirrored about an anchor are at hand too, and then one recursion does for both:

    u(+t) = 2 sum_k c_k T_k u - u(-t),    v(+t) = v(-t) + 2 sum_k d_k T_k u.

Each row (one realization and one start) is treated by itself, in an order that depends on nothing but its own chain,
start and times: a row gives the same bits alone and in any batch, whatever the number of threads.

Importing this file imports Numba; :mod:`chebyshev` does it at the first use.
"""
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, types
from numba.extending import intrinsic

from torchchain.evolvers.expansion import LEAP, LONGEST, REACH

# What a march leaves behind at every output time; the fields are those whose transforms make the energy of a
# wavenumber. Kinds 3 and up write as many fields as they name.
STATES, SITE_MOMENTS, BOND_MOMENTS, UNIFORM_FIELDS, SITE_FIELDS, BOND_FIELDS = range(6)

# The mirrored form adds up rounding errors like a random walk's integral; a plain step now and then ends that.
RESTART = 64
# Dropped at the edges of the active window: energy norm below half an ulp of the whole chain's.
TRIM = 2.0**-53

_SLACK = 8.9e-16  # times closer than this, relative to themselves, count as equal on a uniform grid
_PAD = 8  # cells on either side of a row: at least one, kept at 64 bytes for alignment
_RING = 6  # rows of T_k alive at a time: four that are summed together and the two before them

_kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
_summing_kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})


def _widen(typing_context):
    """Lets LLVM take the widest vectors there are in the function that calls this and in what is inlined there.

    It prefers half of that on processors with 512 bits, as short loops gain nothing; these are long, and gain a
    tenth and more. It is a function's own attribute: other code that Numba compiles is left alone.
    """

    def generate(context, builder, signature, arguments):
        attributes = builder.function.attributes
        if isinstance(attributes, set):  # whose own add, in llvmlite, knows no such pairs
            set.add(attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


_wide_vectors: Any = intrinsic(_widen)

# Rows of the scratch are reached as offsets into one flat array, and indices are unsigned: signed ones make Numba
# test for a negative index at every load, which keeps the loops from being vectorized.
_U = np.uint64


@_kernel
def _aligned(size):
    """Zeros that begin at a multiple of 64 bytes: a fifth faster than where vectors straddle cache lines."""
    cells = np.zeros(size + 8)
    skipped = (-(cells.ctypes.data // 8)) % 8
    return cells[skipped : skipped + size]


@_kernel
def _first(w, middle, new, left, right, n):
    """T_1 = x T_0 on n particles."""
    _wide_vectors()
    b, c, f, g, one = _U(middle), _U(new), _U(left), _U(right), _U(1)
    for i in range(_U(n)):
        x = w[b + i]
        w[c + i] = 0.5 * (w[f + i] * (w[b + i - one] - x) + w[g + i] * (w[b + i + one] - x)) + x


@_kernel
def _next(w, old, middle, new, left, right, n):
    """T_k+1 = 2 x T_k - T_k-1 on n particles; differences first, so that a translation stays one exactly."""
    _wide_vectors()
    a, b, c, f, g, one = _U(old), _U(middle), _U(new), _U(left), _U(right), _U(1)
    for i in range(_U(n)):
        x = w[b + i]
        w[c + i] = (w[f + i] * (w[b + i - one] - x) + w[g + i] * (w[b + i + one] - x)) + (2.0 * x - w[a + i])


@_kernel
def _next_even(w, old, middle, new, left, n):
    """:func:`_next` where both contacts of every particle are equally stiff."""
    _wide_vectors()
    a, b, c, f, one = _U(old), _U(middle), _U(new), _U(left), _U(1)
    for i in range(_U(n)):
        x = w[b + i]
        w[c + i] = w[f + i] * ((w[b + i - one] - x) + (w[b + i + one] - x)) + (2.0 * x - w[a + i])


@_kernel
def _add_four(w, u, v, row0, row1, row2, row3, for_u, for_v, j, k, n):
    """Four terms of the sums for the displacement and velocity of one output."""
    _wide_vectors()
    c0, c1, c2, c3 = for_u[j, k], for_u[j, k + 1], for_u[j, k + 2], for_u[j, k + 3]
    d0, d1, d2, d3 = for_v[j, k], for_v[j, k + 1], for_v[j, k + 2], for_v[j, k + 3]
    p, q, a, b, c, d = _U(u), _U(v), _U(row0), _U(row1), _U(row2), _U(row3)
    for i in range(_U(n)):
        t0, t1, t2, t3 = w[a + i], w[b + i], w[c + i], w[d + i]
        w[p + i] = w[p + i] + c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3
        w[q + i] = w[q + i] + d0 * t0 + d1 * t1 + d2 * t2 + d3 * t3


@_kernel
def _add_two(w, u, v, row0, row1, for_u, for_v, j, k, n):
    """The same for two terms."""
    _wide_vectors()
    c0, c1, d0, d1 = for_u[j, k], for_u[j, k + 1], for_v[j, k], for_v[j, k + 1]
    p, q, a, b = _U(u), _U(v), _U(row0), _U(row1)
    for i in range(_U(n)):
        t0, t1 = w[a + i], w[b + i]
        w[p + i] = w[p + i] + c0 * t0 + c1 * t1
        w[q + i] = w[q + i] + d0 * t0 + d1 * t1


@_kernel
def _first_four(w, u, v, row0, row1, row2, row3, for_u, for_v, j, keep_u, keep_v, n):
    """Terms 0 to 3; what the output's rows held is kept with the factors 0, 1 or -1."""
    _wide_vectors()
    c0, c1, c2, c3 = for_u[j, 0], for_u[j, 1], for_u[j, 2], for_u[j, 3]
    d0, d1, d2, d3 = for_v[j, 0], for_v[j, 1], for_v[j, 2], for_v[j, 3]
    p, q, a, b, c, d = _U(u), _U(v), _U(row0), _U(row1), _U(row2), _U(row3)
    for i in range(_U(n)):
        t0, t1, t2, t3 = w[a + i], w[b + i], w[c + i], w[d + i]
        w[p + i] = keep_u * w[p + i] + c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3
        w[q + i] = keep_v * w[q + i] + d0 * t0 + d1 * t1 + d2 * t2 + d3 * t3


@_summing_kernel
def _moments_site(w, u, v, mass, contact, reference, first, n):
    """Sums of E, q E and q^2 E over n particles, E of Eq. 36 and q the particle number minus the reference."""
    _wide_vectors()
    p, s, b, k, one = _U(u), _U(v), _U(mass), _U(contact), _U(1)
    total, center, width = 0.0, 0.0, 0.0
    q = first - reference
    for i in range(_U(n)):
        x, y = w[p + i], w[s + i]
        energy = w[b + i] * y * y + x * (w[k + i] * (x - w[p + i - one]) + w[k + i + one] * (x - w[p + i + one]))
        number = q + np.float64(np.int64(i))
        total += energy
        center += number * energy
        width += number * number * energy
    return 0.5 * total, 0.5 * center, 0.5 * width


@_summing_kernel
def _moments_bond(w, u, v, mass, contact, reference, first, n):
    """The same with E of Eq. A3; the other half of a wall contact is added by the caller."""
    _wide_vectors()
    p, s, b, k, one = _U(u), _U(v), _U(mass), _U(contact), _U(1)
    total, center, width = 0.0, 0.0, 0.0
    q = first - reference
    for i in range(_U(n)):
        x, y = w[p + i], w[s + i]
        left, right = x - w[p + i - one], w[p + i + one] - x
        energy = w[b + i] * y * y + 0.5 * (w[k + i] * left * left + w[k + i + one] * right * right)
        number = q + np.float64(np.int64(i))
        total += energy
        center += number * energy
        width += number * number * energy
    return 0.5 * total, 0.5 * center, 0.5 * width


@_kernel
def _bessel(z, values):
    """J_0(z) to J_top(z) by downward recurrence (Miller), normalized by J_0 + 2 J_2 + 2 J_4 + ... = 1.

    The recurrence starts where J is below 1e-25 (see :func:`_top_order`), so its start does not show.
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


@_kernel
def _top_order(z):
    """An even order at which J(z) is below 1e-25: by Kapteyn's bound at this distance above z, for any z."""
    return 2 * int(0.5 * z + 8.0 * z ** (1.0 / 3.0) + 10.0)


@_kernel
def _coefficients(frequency, time, tolerance, bessel, cosine, drift, slope):
    """c_k, s_k and d_k of this file's heading for one time after the anchor; returns the number of terms.

    Terms are dropped while the sums of |c_k|, W |s_k| and |d_k| / W over all that are dropped stay within the
    tolerance: summed over the Bessel functions themselves, which above the order z are positive and fall faster
    than geometrically. As |T_k| <= 1 on the spectrum, these sums bound the error in the mass norm of W u and of v.
    The number is even and at least four. The first coefficient of each kind is then set so that a
    translation of the whole chain, on which every T_k is 1, moves exactly: c = 1, s = time, d = 0.
    """
    z = frequency * time
    values = bessel[: _top_order(z) + 1]
    _bessel(z, values)
    terms = 1
    odd = 0.0  # J_2k+1 + J_2k+3 + ...
    dropped_cosine, dropped_drift, dropped_slope = 0.0, 0.0, 0.0
    for k in range(values.size // 2 - 1, 0, -1):
        odd += values[2 * k + 1]
        difference = values[2 * k - 1] - values[2 * k + 1]
        if terms == 1:
            dropped_cosine += 2 * abs(values[2 * k])
            dropped_drift += 4 * abs(odd)
            dropped_slope += abs(difference)
            if max(dropped_cosine, dropped_drift, dropped_slope) > tolerance:
                terms = k + 1
        if k < cosine.size:
            cosine[k] = 2 * values[2 * k]
            drift[k] = 4 * odd / frequency
            slope[k] = frequency * difference
    terms = min(max(4, 2 * ((terms + 1) // 2)), cosine.size)
    rest_cosine, rest_drift, rest_slope = 0.0, 0.0, 0.0
    for k in range(terms - 1, 0, -1):
        rest_cosine += cosine[k]
        rest_drift += drift[k]
        rest_slope += slope[k]
    cosine[0], drift[0], slope[0] = 1.0 - rest_cosine, time - rest_drift, -rest_slope
    return terms


class Row(NamedTuple):
    """Where one chain lies in the flat scratch, and what kind of chain it is."""

    n: int
    periodic: bool
    even: bool  # both contacts of every particle are equally stiff
    mass: int
    contact: int  # stiffness of the left contact
    left: int  # 4 (stiffness of the left contact) / (W^2 mass)
    right: int
    ring: np.ndarray  # rows for T_k, k modulo 6


@_kernel
def _close(w, row, at):
    """Fills the cells beyond both ends of a periodic row."""
    w[at - 1] = w[at + row.n - 1]
    w[at + row.n] = w[at]


@_kernel
def _clear(w, begin, end):
    for i in range(_U(begin), _U(max(begin, end))):
        w[i] = 0.0


@_kernel
def _expand(w, row, source, low, high, count, u, v, terms, for_u, for_v, keep_u, keep_v):
    """Adds sum_k for_u[j, k] T_k and sum_k for_v[j, k] T_k, T_k applied to the source, to the states u[j], v[j].

    The source is zero outside [low, high), and T_k outside [low - k, high + k): nothing else is touched. What the
    states held before is kept with the factors 0, 1 or -1.

    Returns:
        The window that the states now fill.
    """
    most = 0
    for j in range(count):
        most = max(most, terms[j])
    start, stop = low, high
    for k in range(0, most, 4):
        before_start, before_stop = start, stop
        start, stop, full = low - k - 3, high + k + 3, False
        if not row.periodic:
            start, stop = max(start, 0), min(stop, row.n)
        elif start < 1 or stop > row.n - 1:  # the window has closed around the ring
            start, stop, full = 0, row.n, True
        size = stop - start
        if k > 0:  # the two rows before these held less, and beyond it they are zero
            for q in range(k - 2, k):
                at = row.ring[q % _RING]
                _clear(w, at + start - 1, at + before_start)
                _clear(w, at + before_stop, at + stop + 1)
                if full:
                    _close(w, row, at)
        for q in range(max(k, 1), min(k + 4, most)):
            new = row.ring[q % _RING]
            middle = source if q == 1 else row.ring[(q - 1) % _RING]
            old = source if q == 2 else row.ring[(q - 2) % _RING]
            if q == 1:
                _first(w, middle + start, new + start, row.left + start, row.right + start, size)
            elif row.even:
                _next_even(w, old + start, middle + start, new + start, row.left + start, size)
            else:
                _next(w, old + start, middle + start, new + start, row.left + start, row.right + start, size)
            if full:
                _close(w, row, new)
            else:
                w[new + start - 1] = 0.0
                w[new + stop] = 0.0
        t0 = start + (source if k == 0 else row.ring[k % _RING])
        t1 = start + row.ring[(k + 1) % _RING]
        t2 = start + row.ring[(k + 2) % _RING]
        t3 = start + row.ring[(k + 3) % _RING]
        for j in range(count):
            if k == 0:
                _first_four(w, u[j] + start, v[j] + start, t0, t1, t2, t3, for_u, for_v, j, keep_u, keep_v, size)
            elif k + 2 < terms[j]:
                _add_four(w, u[j] + start, v[j] + start, t0, t1, t2, t3, for_u, for_v, j, k, size)
            elif k < terms[j]:
                _add_two(w, u[j] + start, v[j] + start, t0, t1, for_u, for_v, j, k, size)
    return start, stop


@_kernel
def _quiet(w, row, u, v, used, stiff, p, limit):
    """Whether particle p has less of the squared energy norm than the limit in each of the states.

    Its share is b v^2 plus u^2 times the stiffness of both contacts: what the chain would lose with it.
    """
    for j in range(used):
        x, y = w[u[j] + p], w[v[j] + p]
        share = w[row.mass + p] * (y * y + stiff * (w[row.left + p] + w[row.right + p]) * x * x)
        if share > limit or (share == 0.0 and (x != 0.0 or y != 0.0)):  # the square of 1e-170 is zero
            return False
    return True


@_kernel
def _trim(w, row, u, v, used, stiff, limit, low, high):
    """The window without the edges that are quiet in all the used states; there, all states are set to zero."""
    start, stop = low, high
    while start < stop and _quiet(w, row, u, v, used, stiff, start, limit):
        start += 1
    while start < stop and _quiet(w, row, u, v, used, stiff, stop - 1, limit):
        stop -= 1
    if start == low and stop == high:
        return start, stop
    for j in range(u.size):
        for at in (u[j], v[j]):
            _clear(w, at + low, at + start)
            _clear(w, at + stop, at + high)
    return start, stop


@_kernel
def _silent(w, at, low, high):
    """Whether a row is zero."""
    for i in range(_U(at + low), _U(at + high)):  # noqa: SIM110 (Numba compiles no generators inside all)
        if w[i] != 0.0:
            return False
    return True


@_kernel
def _start_energy(w, row, u, v):
    """Twice the energy of a state."""
    if row.periodic:
        _close(w, row, u)
    energy = 0.0
    for p in range(row.n):
        stretch = w[u + p] - w[u + p - 1]
        energy += w[row.mass + p] * w[v + p] ** 2 + w[row.contact + p] * stretch**2
    if not row.periodic:
        energy += w[row.contact + row.n] * w[u + row.n - 1] ** 2
    return energy


@_kernel
def _wall_moments(w, row, u, reference):
    """What :func:`_moments_bond` leaves out: a wall contact belongs as a whole to its one particle."""
    first, last = w[u], w[u + row.n - 1]
    e0 = 0.25 * w[row.contact] * first * first
    e1 = 0.25 * w[row.contact + row.n] * last * last
    q0, q1 = 1.0 - reference, row.n - reference
    return e0 + e1, q0 * e0 + q1 * e1, q0 * q0 * e0 + q1 * q1 * e1


@_kernel
def _record_moments(w, row, u, v, kind, low, high, reference, out):
    """Leaves total, center and width of one state's energy behind.

    Returns:
        The reference for the next state's moments, the particle at this center: the width must not come out as
        a small difference of large numbers.
    """
    if kind == SITE_MOMENTS:
        size = high - low
        total, first, second = _moments_site(
            w, u + low, v + low, row.mass + low, row.contact + low, reference, low + 1.0, size
        )
    else:
        # Half of the outermost contacts' energy belongs to the particles at rest beyond the window.
        if row.periodic and (low == 0 or high == row.n):
            low, high = 0, row.n
        low, high = max(low - 1, 0), min(high + 1, row.n)
        size = high - low
        total, first, second = _moments_bond(
            w, u + low, v + low, row.mass + low, row.contact + low, reference, low + 1.0, size
        )
        if not row.periodic:
            more = _wall_moments(w, row, u, reference)
            total, first, second = total + more[0], first + more[1], second + more[2]
    out[0], out[1], out[2] = total, np.nan, np.nan
    if not total > 0.0:
        return reference
    offset = first / total
    out[1] = reference + offset
    out[2] = second / total - offset * offset
    return reference + np.floor(offset + 0.5)


@_kernel
def _record_fields(w, row, u, v, kind, out, r, i):
    """Leaves one state, or the fields that make up its energy in wavenumber space, in out[:, r, i]."""
    _wide_vectors()
    # One field a loop: with more pointers in one, the compiler gives up proving that they are apart.
    n, one = _U(row.n), _U(1)
    p, s, b, k = _U(u), _U(v), _U(row.mass), _U(row.contact)
    first, second = out[0, r, i], out[1, r, i]
    if kind == BOND_FIELDS:
        for q in range(n):
            first[q] = math.sqrt(w[b + q]) * w[s + q]
        for q in range(n):
            second[q] = math.sqrt(w[k + q]) * (w[p + q] - w[p + q - one])
        return
    velocity = second if kind == STATES else first
    displacement = first if kind == STATES else out[2, r, i]
    for q in range(n):
        velocity[q] = w[s + q]
    for q in range(n):
        displacement[q] = w[p + q]
    if kind != STATES:
        for q in range(n):
            second[q] = w[b + q] * w[s + q]
    if kind == SITE_FIELDS:
        pull = out[3, r, i]
        for q in range(n):
            x = w[p + q]
            pull[q] = w[k + q] * (x - w[p + q - one]) + w[k + q + one] * (x - w[p + q + one])


class Tables(NamedTuple):
    """Coefficients for the times of a segment, (time, term)."""

    offsets: np.ndarray  # time after the anchor; -1: none yet
    terms: np.ndarray
    cosine: np.ndarray
    drift: np.ndarray
    slope: np.ndarray
    twice_cosine: np.ndarray
    twice_slope: np.ndarray
    bessel: np.ndarray  # scratch


@_kernel
def _tabulate(tables, frequency, tolerance, anchor, times, leaps, slack):
    """Fills the tables for these times, or for the first of the leaps to them, unless they hold them already.

    Returns:
        Whether the tables are filled anew.
    """
    known = leaps == 1
    for j in range(times.size):
        known = known and abs(times[j] - anchor - tables.offsets[j]) <= slack * times[j]
    if known:
        return False
    for j in range(times.size):
        offset = (times[j] - anchor) / leaps
        tables.offsets[j] = offset
        tables.terms[j] = _coefficients(
            frequency, offset, tolerance, tables.bessel, tables.cosine[j], tables.drift[j], tables.slope[j]
        )
        for k in range(tables.terms[j]):
            tables.twice_cosine[j, k] = 2.0 * tables.cosine[j, k]
            tables.twice_slope[j, k] = 2.0 * tables.slope[j, k]
    return True


@_kernel
def _lay_out(w, row, masses, contacts, stiff):
    """Puts one chain into the scratch; returns whether both contacts of every particle are equally stiff."""
    even = True
    for p in range(row.n):
        mass, left, right = masses[p], contacts[p], contacts[p + 1]
        w[row.mass + p], w[row.contact + p] = mass, left
        w[row.left + p], w[row.right + p] = left / (mass * stiff), right / (mass * stiff)
        even = even and left == right
    w[row.contact + row.n] = contacts[row.n]
    return even


@_kernel
def _reverse(values, last):
    """Turns values[: last + 1] around."""
    for j in range((last + 1) // 2):
        values[j], values[last - j] = values[last - j], values[j]


@_kernel
def _advance(w, row, u, v, low, high, count, tables, mirror):
    """The states after the anchor u[0], v[0], put into rows 1 to count; returns the window that they fill."""
    if mirror:
        return _expand(
            w,
            row,
            u[0],
            low,
            high,
            count,
            u[1:],
            v[1:],
            tables.terms,
            tables.twice_cosine,
            tables.twice_slope,
            -1.0,
            1.0,
        )
    start, stop, keep = low, high, 0.0
    if not _silent(w, v[0], low, high):
        start, stop = _expand(
            w, row, v[0], low, high, count, u[1:], v[1:], tables.terms, tables.drift, tables.cosine, 0.0, 0.0
        )
        keep = 1.0
    if keep == 0.0 or not _silent(w, u[0], low, high):
        start, stop = _expand(
            w, row, u[0], low, high, count, u[1:], v[1:], tables.terms, tables.cosine, tables.slope, keep, keep
        )
    return start, stop


@_kernel
def march(
    begin, end, masses, contacts, frequencies, starts, periodic, times, tolerance, mirrored, kind,
    anchors, latest, clock, fields, moments, first,
):  # fmt: skip
    """Evolves rows begin to end - 1 through the times, each in cache from the first time to the last.

    Args:
        begin, end: rows; row r is start r % starts of realization r // starts.
        masses: (realization, particle).
        contacts: stiffness of contacts 0 to N, (realization, N + 1); on a ring the last is the first.
        frequencies: W, no less than any frequency of the chain, (realization,).
        starts: rows per realization.
        periodic: whether the chains are rings.
        times: (time,), increasing, not before the clock.
        tolerance: largest sum of dropped coefficients in a segment.
        mirrored: use the states mirrored about an anchor where the times form a uniform grid, and take times that
            are equal within rounding as equal. Without it the states do not depend on how the times are cut into
            calls, to the last bit.
        kind: STATES to BOND_FIELDS.
        anchors, latest: states (row, 2, particle) at the last anchor and at the last time, updated unless ``latest``
            is empty, when these times are the only ones.
        clock: (row, 4): time of the anchor, times since it, last time, and twice the energy at the start (negative
            while unknown), updated.
        fields: (field, row - first, time, particle), written if the kind is one of states or fields.
        moments: (row - first, time, 3), total, center and width, written if the kind is one of moments.
        first: the row that comes first in ``fields`` or ``moments``.
    """
    n, steps = masses.shape[1], times.size
    slack = _SLACK if mirrored else 0.0
    stride = 8 * ((n + 2 * _PAD + 7) // 8)
    w = _aligned((4 + _RING + 2 * (LONGEST + 1)) * stride)
    ring = (4 + np.arange(_RING)) * stride + _PAD
    u = np.zeros(LONGEST + 1, np.int64)
    v = np.zeros(LONGEST + 1, np.int64)
    when = np.zeros(LONGEST + 1)  # the time of the state in rows u[j], v[j]

    longest_gap = times[0] - clock[begin, 2]
    for i in range(1, steps):
        longest_gap = max(longest_gap, times[i] - times[i - 1])
    top = _top_order(1.001 * max(REACH, min(LEAP, frequencies.max() * longest_gap)))
    table = np.zeros((5, LONGEST, 4 * (top // 8 + 1)))
    tables = Tables(
        np.zeros(LONGEST),
        np.zeros(LONGEST, np.int64),
        table[0],
        table[1],
        table[2],
        table[3],
        table[4],
        np.empty(top + 1),
    )

    realization = -1
    row = Row(n, periodic, True, _PAD, stride + _PAD, 2 * stride + _PAD, 3 * stride + _PAD, ring)
    frequency, stiff = 1.0, 1.0
    for r in range(begin, end):
        if r // starts != realization:
            realization = r // starts
            frequency = frequencies[realization]
            stiff = 0.25 * frequency * frequency
            even = _lay_out(w, row, masses[realization], contacts[realization], stiff)
            row = Row(n, periodic, even, row.mass, row.contact, row.left, row.right, ring)
            tables.offsets[:] = -1.0
        _clear(w, ring[0] - _PAD, w.size)
        for j in range(LONGEST + 1):
            u[j] = (4 + _RING + 2 * j) * stride + _PAD
            v[j] = u[j] + stride
        w[u[0] : u[0] + n], w[v[0] : v[0] + n] = anchors[r, 0], anchors[r, 1]
        anchor, since = clock[r, 0], int(clock[r, 1])
        when[:] = -np.inf
        when[0] = anchor
        here = 0  # the row that holds the latest state
        if since > 0:  # in the last row, which no other time of this segment will need
            here = LONGEST
            w[u[here] : u[here] + n], w[v[here] : v[here] + n] = latest[r, 0], latest[r, 1]
            when[here] = clock[r, 2]
        if clock[r, 3] < 0:
            clock[r, 3] = _start_energy(w, row, u[0], v[0])
        limit = TRIM * TRIM * clock[r, 3]
        low, high = _trim(w, row, u[:1], v[:1], 1, stiff, limit, 0, n)
        start, stop = 0, n
        reference = 0.5 * (low + 1 + high)
        history = 0  # states on the grid before the anchor, in rows 1, 2, ...
        age = 0  # mirrored segments since the last plain one
        i = 0
        while i < steps:
            if since > 0 and (since >= LONGEST or frequency * (times[i] - anchor) > REACH):
                # The latest state becomes the anchor, and those before it follow in order.
                _reverse(u, here)
                _reverse(v, here)
                _reverse(when, here)
                history = here if mirrored else 0
                low, high = _trim(w, row, u, v, history + 1, stiff, limit, start, stop)
                anchor, since, here = when[0], 0, 0
            count = 1
            if since > 0 or times[i] > anchor:
                while (
                    i + count < steps and since + count < LONGEST and frequency * (times[i + count] - anchor) <= REACH
                ):
                    count += 1
                leaps = math.ceil(frequency * (times[i] - anchor) / LEAP)
                _tabulate(tables, frequency, tolerance, anchor, times[i : i + count], leaps, slack)
                mirror = leaps == 1 and count <= history and age < RESTART
                for j in range(count):
                    passed = anchor - when[j + 1]
                    mirror = mirror and abs(passed - tables.offsets[j]) <= slack * times[i + j]
                if periodic:
                    _close(w, row, u[0])
                    _close(w, row, v[0])
                start, stop = _advance(w, row, u, v, low, high, count, tables, mirror)
                age = age + 1 if mirror else 0
                for j in range(count):
                    when[j + 1] = anchor + tables.offsets[j] if mirrored or leaps > 1 else times[i + j]
                since += count
                here = count
                if leaps > 1:
                    continue
            for j in range(count):
                at = j + 1 if since > 0 else 0
                if periodic:
                    _close(w, row, u[at])
                if kind in (SITE_MOMENTS, BOND_MOMENTS):
                    inner, outer = (start, stop) if since > 0 else (low, high)
                    reference = _record_moments(
                        w, row, u[at], v[at], kind, inner, outer, reference, moments[r - first, i + j]
                    )
                else:
                    _record_fields(w, row, u[at], v[at], kind, fields, r - first, i + j)
            i += count
        if latest.size == 0:
            continue
        anchors[r, 0], anchors[r, 1] = w[u[0] : u[0] + n], w[v[0] : v[0] + n]
        latest[r, 0], latest[r, 1] = w[u[here] : u[here] + n], w[v[here] : v[here] + n]
        clock[r, 0], clock[r, 1], clock[r, 2] = anchor, since, times[steps - 1]


@_kernel
def squared_bounds(begin, end, masses, contacts, periodic, sweeps, bounds):
    """``Chain.squared_frequency_bound`` of realizations begin to end - 1.

    Args:
        begin, end: realizations.
        masses, contacts, periodic: see :func:`march`.
        sweeps: of the bound's power iteration.
        bounds: (realization,), written.
    """
    n = masses.shape[1]
    x, image = np.empty(n + 2), np.empty(n)
    for r in range(begin, end):
        x[:] = 1.0
        largest = 0.0
        for _ in range(sweeps + 1):
            x[0] = x[n] if periodic else 0.0
            x[n + 1] = x[1] if periodic else 0.0
            largest, top = 0.0, 0.0
            for p in range(n):
                here = x[p + 1]
                sums = contacts[r, p] * (here + x[p]) + contacts[r, p + 1] * (here + x[p + 2])
                value = sums / masses[r, p]
                largest = max(largest, value / here)
                image[p] = math.sqrt(here * value)
                top = max(top, image[p])
            for p in range(n):
                x[p + 1] = max(image[p] / top, 1e-77)
        bounds[r] = largest * (1 + 1.8e-15)


@_summing_kernel
def bin_spectra(spectra, kind, strain, normalize, row, time, bands, totals):
    """Energies of wavenumbers (Eq. 43) summed into bands (Eq. 44).

    Args:
        spectra: transforms of the fields that :func:`march` leaves, without a factor, (field, row, time,
            2 (N/2 + 1)): the real and the imaginary part of each wavenumber in turn.
        kind: UNIFORM_FIELDS, SITE_FIELDS or BOND_FIELDS.
        strain: stiffness 4 kappa sin^2(k / 2) of a uniform ring, twice for each wavenumber, (2 (N/2 + 1),).
        normalize: divide by the total.
        row, time: where in the results the spectra belong.
        bands: (row, time, band), written.
        totals: energy of all wavenumbers, k = 0 among them, (row, time), written.
    """
    _wide_vectors()
    count, size, n_bands = spectra.shape[0], spectra.shape[3], bands.shape[2]
    width = (size - 2) // n_bands
    # 1/2 for the energy and 1/N for the unitary transform; k and -k are two, except where they are one.
    scale = 1.0 / (size - 2)
    energy = np.empty(size)
    for r in range(spectra.shape[1]):
        for i in range(spectra.shape[2]):
            p, q = spectra[0, r, i], spectra[1, r, i]
            s, t = spectra[min(2, count - 1), r, i], spectra[min(3, count - 1), r, i]
            out = bands[row + r, time + i]
            if kind == UNIFORM_FIELDS:
                for k in range(size):
                    energy[k] = p[k] * q[k] + strain[k] * s[k] * s[k]
            elif kind == SITE_FIELDS:
                for k in range(size):
                    energy[k] = p[k] * q[k] + s[k] * t[k]
            else:
                for k in range(size):
                    energy[k] = p[k] * p[k] + q[k] * q[k]
            energy[0] *= 0.5
            energy[size - 2] *= 0.5
            total = energy[0]
            for band in range(n_bands):
                part = 0.0
                start = _U(2 + band * width)
                for k in range(_U(width)):
                    part += energy[start + k]
                out[band] = part
                total += part
            factor = 1.0 / total if normalize else scale
            for band in range(n_bands):
                out[band] *= factor
            totals[row + r, time + i] = total * scale


@dataclass(frozen=True, eq=False)
class Rows:
    """Chains and their starts, laid out for the kernels.

    Attributes:
        masses: (realization, particle), float64.
        contacts: (realization, N + 1), float64; on a ring the last contact is the first again.
        frequencies: W, (realization,), float64.
        states: displacement and velocity, (row, 2, particle), float64; row r starts realization r // starts.
        starts: rows per realization.
        periodic: whether the chains are rings.
        tolerance: largest sum of dropped coefficients in a segment.
    """

    masses: np.ndarray
    contacts: np.ndarray
    frequencies: np.ndarray
    states: np.ndarray
    starts: int
    periodic: bool
    tolerance: float

    @property
    def count(self) -> int:
        return len(self.states)


class March:
    """Rows on their way through time; each call takes some of them to the next window of times.

    Args:
        rows: chains and starts.
        mirrored: see :func:`march`.
        once: there will be no second window, and nothing is kept for it.
    """

    def __init__(self, rows: Rows, mirrored: bool = False, once: bool = False) -> None:
        self.rows = rows
        self.mirrored = mirrored
        self.anchors = rows.states if once else rows.states.copy()
        self.latest = np.empty_like(rows.states[:0] if once else rows.states)
        self.clock = np.zeros((rows.count, 4))
        self.clock[:, 3] = -1

    def fields(self, begin: int, end: int, times: np.ndarray, kind: int, out: np.ndarray, first: int = 0) -> None:
        """Leaves the states or fields of rows begin to end - 1 in ``out``, (field, row - first, time, particle)."""
        self._run(begin, end, times, kind, out, np.empty((0, 0, 3)), first)

    def moments(self, begin: int, end: int, times: np.ndarray, kind: int, out: np.ndarray) -> None:
        """Leaves total, center and width of the energy of rows begin to end - 1 in ``out``, (row, time, 3)."""
        self._run(begin, end, times, kind, np.empty((0, 0, 0, 0)), out, 0)

    def _run(
        self, begin: int, end: int, times: np.ndarray, kind: int, fields: np.ndarray, moments: np.ndarray, first: int
    ) -> None:
        rows = self.rows
        march(
            begin, end, rows.masses, rows.contacts, rows.frequencies, rows.starts, rows.periodic, times,
            rows.tolerance, self.mirrored, kind, self.anchors, self.latest, self.clock, fields, moments, first,
        )  # fmt: skip


def ranges(count: int, workers: int) -> list[tuple[int, int]]:
    """Rows 0 to count - 1 as a few ranges (begin, end) for each worker."""
    size = -(-count // (4 * workers if workers > 1 else 1))
    return [(begin, min(begin + size, count)) for begin in range(0, count, size)]


def share(work: Callable[[int, int], None], count: int) -> None:
    """Runs work(begin, end) over rows 0 to count - 1 side by side, on as many threads as torch uses.

    For work without torch operations, whose number of threads is left alone: setting it, as
    :func:`torchchain.threads.map_in_order` must, makes later small operations slow beside a busy process.
    """
    workers = min(torch.get_num_threads(), count)
    if workers == 1:
        work(0, count)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda part: work(*part), ranges(count, workers)))
