"""The recursion of Chebyshev polynomials on one chain in cache, and sums of its terms. Imports Numba.

A chain and its states are rows of one flat scratch, each with cells beyond its ends: a wall at rest, or on a ring what
is there. Only the window of particles that move is touched.
"""
# mypy: allow-untyped-defs

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchchain.evolvers.compiling import U, kernel, wide_vectors

PAD = 8  # cells on either side of a row: at least one, kept at 64 bytes for alignment
RING = 6  # rows of T_k alive at a time: four that are summed together and the two before them


@kernel
def aligned(size):
    """Zeros that begin at a multiple of 64 bytes: a fifth faster than where vectors straddle cache lines."""
    cells = np.zeros(size + 8)
    skipped = (-(cells.ctypes.data // 8)) % 8
    return cells[skipped : skipped + size]


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


@kernel
def close(w, row, at):
    """Fills the cells beyond both ends of a periodic row."""
    w[at - 1] = w[at + row.n - 1]
    w[at + row.n] = w[at]


@kernel
def clear(w, begin, end):
    """Zeros from cell begin to end - 1."""
    for i in range(U(begin), U(max(begin, end))):
        w[i] = 0.0


@kernel
def lay_out(w, row, masses, contacts, stiff):
    """Puts one chain into the scratch; returns whether both contacts of every particle are equally stiff."""
    even = True
    for p in range(row.n):
        mass, left, right = masses[p], contacts[p], contacts[p + 1]
        w[row.mass + p], w[row.contact + p] = mass, left
        w[row.left + p], w[row.right + p] = left / (mass * stiff), right / (mass * stiff)
        even = even and left == right
    w[row.contact + row.n] = contacts[row.n]
    return even


@kernel
def _first(w, middle, new, left, right, n):
    """T_1 = x T_0 on n particles."""
    wide_vectors()
    b, c, f, g, one = U(middle), U(new), U(left), U(right), U(1)
    for i in range(U(n)):
        x = w[b + i]
        w[c + i] = 0.5 * (w[f + i] * (w[b + i - one] - x) + w[g + i] * (w[b + i + one] - x)) + x


@kernel
def _next(w, old, middle, new, left, right, n):
    """T_k+1 = 2 x T_k - T_k-1 on n particles; differences first, so that a translation stays one exactly."""
    wide_vectors()
    a, b, c, f, g, one = U(old), U(middle), U(new), U(left), U(right), U(1)
    for i in range(U(n)):
        x = w[b + i]
        w[c + i] = (w[f + i] * (w[b + i - one] - x) + w[g + i] * (w[b + i + one] - x)) + (2.0 * x - w[a + i])


@kernel
def _next_even(w, old, middle, new, left, n):
    """:func:`_next` where both contacts of every particle are equally stiff."""
    wide_vectors()
    a, b, c, f, one = U(old), U(middle), U(new), U(left), U(1)
    for i in range(U(n)):
        x = w[b + i]
        w[c + i] = w[f + i] * ((w[b + i - one] - x) + (w[b + i + one] - x)) + (2.0 * x - w[a + i])


@kernel
def _add_four(w, u, v, row0, row1, row2, row3, for_u, for_v, j, k, n):
    """Four terms of the sums for the displacement and velocity of one output."""
    wide_vectors()
    c0, c1, c2, c3 = for_u[j, k], for_u[j, k + 1], for_u[j, k + 2], for_u[j, k + 3]
    d0, d1, d2, d3 = for_v[j, k], for_v[j, k + 1], for_v[j, k + 2], for_v[j, k + 3]
    p, q, a, b, c, d = U(u), U(v), U(row0), U(row1), U(row2), U(row3)
    for i in range(U(n)):
        t0, t1, t2, t3 = w[a + i], w[b + i], w[c + i], w[d + i]
        w[p + i] = w[p + i] + c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3
        w[q + i] = w[q + i] + d0 * t0 + d1 * t1 + d2 * t2 + d3 * t3


@kernel
def _add_two(w, u, v, row0, row1, for_u, for_v, j, k, n):
    """The same for two terms."""
    wide_vectors()
    c0, c1, d0, d1 = for_u[j, k], for_u[j, k + 1], for_v[j, k], for_v[j, k + 1]
    p, q, a, b = U(u), U(v), U(row0), U(row1)
    for i in range(U(n)):
        t0, t1 = w[a + i], w[b + i]
        w[p + i] = w[p + i] + c0 * t0 + c1 * t1
        w[q + i] = w[q + i] + d0 * t0 + d1 * t1


@kernel
def _first_four(w, u, v, row0, row1, row2, row3, for_u, for_v, j, keep_u, keep_v, n):
    """Terms 0 to 3; what the output's rows held is kept with the factors 0, 1 or -1."""
    wide_vectors()
    c0, c1, c2, c3 = for_u[j, 0], for_u[j, 1], for_u[j, 2], for_u[j, 3]
    d0, d1, d2, d3 = for_v[j, 0], for_v[j, 1], for_v[j, 2], for_v[j, 3]
    p, q, a, b, c, d = U(u), U(v), U(row0), U(row1), U(row2), U(row3)
    for i in range(U(n)):
        t0, t1, t2, t3 = w[a + i], w[b + i], w[c + i], w[d + i]
        w[p + i] = keep_u * w[p + i] + c0 * t0 + c1 * t1 + c2 * t2 + c3 * t3
        w[q + i] = keep_v * w[q + i] + d0 * t0 + d1 * t1 + d2 * t2 + d3 * t3


@kernel
def expand(w, row, source, low, high, count, u, v, terms, for_u, for_v, keep_u, keep_v):
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
                at = row.ring[q % RING]
                clear(w, at + start - 1, at + before_start)
                clear(w, at + before_stop, at + stop + 1)
                if full:
                    close(w, row, at)
        for q in range(max(k, 1), min(k + 4, most)):
            new = row.ring[q % RING]
            middle = source if q == 1 else row.ring[(q - 1) % RING]
            old = source if q == 2 else row.ring[(q - 2) % RING]
            if q == 1:
                _first(w, middle + start, new + start, row.left + start, row.right + start, size)
            elif row.even:
                _next_even(w, old + start, middle + start, new + start, row.left + start, size)
            else:
                _next(w, old + start, middle + start, new + start, row.left + start, row.right + start, size)
            if full:
                close(w, row, new)
            else:
                w[new + start - 1] = 0.0
                w[new + stop] = 0.0
        t0 = start + (source if k == 0 else row.ring[k % RING])
        t1 = start + row.ring[(k + 1) % RING]
        t2 = start + row.ring[(k + 2) % RING]
        t3 = start + row.ring[(k + 3) % RING]
        for j in range(count):
            if k == 0:
                _first_four(w, u[j] + start, v[j] + start, t0, t1, t2, t3, for_u, for_v, j, keep_u, keep_v, size)
            elif k + 2 < terms[j]:
                _add_four(w, u[j] + start, v[j] + start, t0, t1, t2, t3, for_u, for_v, j, k, size)
            elif k < terms[j]:
                _add_two(w, u[j] + start, v[j] + start, t0, t1, for_u, for_v, j, k, size)
    return start, stop


@kernel
def advance(w, row, u, v, low, high, count, tables, mirror):
    """The states after the anchor u[0], v[0], put into rows 1 to count; returns the window that they fill."""
    if mirror:
        return expand(
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
        start, stop = expand(
            w, row, v[0], low, high, count, u[1:], v[1:], tables.terms, tables.integral, tables.cosine, 0.0, 0.0
        )
        keep = 1.0
    if keep == 0.0 or not _silent(w, u[0], low, high):
        start, stop = expand(
            w, row, u[0], low, high, count, u[1:], v[1:], tables.terms, tables.cosine, tables.slope, keep, keep
        )
    return start, stop


@kernel
def _quiet(w, row, u, v, used, stiff, p, limit):
    """Whether particle p has less of the squared energy norm than the limit in each of the states.

    Its part is b v^2 plus u^2 times the stiffness of both contacts: what the chain would lose with it.
    """
    for j in range(used):
        x, y = w[u[j] + p], w[v[j] + p]
        part = w[row.mass + p] * (y * y + stiff * (w[row.left + p] + w[row.right + p]) * x * x)
        if part > limit or (part == 0.0 and (x != 0.0 or y != 0.0)):  # the square of 1e-170 is zero
            return False
    return True


@kernel
def trim(w, row, u, v, used, stiff, limit, low, high):
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
            clear(w, at + low, at + start)
            clear(w, at + stop, at + high)
    return start, stop


@kernel
def _silent(w, at, low, high):
    """Whether a row is zero."""
    for i in range(U(at + low), U(at + high)):  # noqa: SIM110 (Numba compiles no generators inside all)
        if w[i] != 0.0:
            return False
    return True


@kernel
def twice_energy(w, row, u, v):
    """Twice the energy of a state."""
    if row.periodic:
        close(w, row, u)
    energy = 0.0
    for p in range(row.n):
        stretch = w[u + p] - w[u + p - 1]
        energy += w[row.mass + p] * w[v + p] ** 2 + w[row.contact + p] * stretch**2
    if not row.periodic:
        energy += w[row.contact + row.n] * w[u + row.n - 1] ** 2
    return energy
