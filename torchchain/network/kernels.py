"""Chebyshev recursions on networks: the Numba kernels behind :mod:`torchchain.network.chebyshev`.

With x = 1 - 2 M^-1 K / W^2, each kernel computes T_k = 2 x T_k-1 - T_k-2 on some of the particles, in place of T_k-2,
and on every third step adds three terms to the sums for the outputs, whose T it has at hand. Every particle gathers the
pulls of its own bonds, so that threads share no cell and the result does not depend on their number.

Two layouts: *gathered*, the neighbors of every particle listed, for any network; and *rows*, for lattices, where the
neighbors of a row of particles are rows, the loops run along them, and nothing need be looked up.

Importing this file imports Numba.
"""
# mypy: allow-untyped-defs, disable-error-code="call-arg"

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numba.cpython.unsafe.tuple import tuple_setitem

_kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract"})
_U = np.uint64


@_kernel
def _count(k, last):
    """How many of T_k-2, T_k-1, T_k are added at step k."""
    return 3 if k % 3 == 2 else (k % 3 + 1 if k == last else 0)


@_kernel
def _terms(k, count, table):
    """Their factors (output, 3, 2, field)."""
    terms = np.zeros((len(table), 3, 2, table.shape[3]))
    for back in range(count):
        terms[:, 2 - back] = table[:, k - back]
    return terms


@lru_cache
def gathered(components: int, fields: int, signed: bool, prestressed: bool):
    """The kernel for so many components of one or two fields, known when it is compiled: loops over them unroll.

    It makes some steps on tiles begin to end - 1, the sums added to while a tile is in cache. Of all tiles, several steps
    are made in one sweep through memory: each follows the one before it at the distance that neighbors need (the "matrix
    powers kernel", Mohiyuddin, Hoemmen, Demmel and Yelick, SC 2009), with the result of one after the other.

        steps: the steps k, as a range (first, after the last); step k makes T_k of T_k-1 and T_k-2.
        last: the last step of all, at which the terms not yet added are.
        cells: (2, particle, column), T_k in cells[k % 2]; columns are (field, component), fields T u, T v, or both.
        sums: (output, 2, particle, component), displacement and velocity.
        table: (output, term, 2, field), what each T of each field contributes to displacement and velocity.
        keep: scratch (particles of a tile, column).
        depth: steps of one sweep.
        lag: tiles by which a step of a sweep follows the one before it.
        tiles: runs of tile t are tiles[t] to tiles[t + 1] - 1, (tile + 1,).
        runs: particles of run r, which have equally many neighbors, are runs[r] to runs[r + 1] - 1, (run + 1,).
        starts, ends: neighbors of particle p are ends[starts[p] : starts[p + 1]], as offsets into the flat cells.
        weight: 4 / (W^2 m), (particle,).
        stiff, directions, across: of each of these bonds, with one component its k; with more the sign of k - T / L
            (looked at where ``signed``: some are negative), n times the root of its size (slot and component,), and T / L
            (where ``prestressed``).
    """
    columns, width = components * fields, _U(components * fields)
    slot, nothing, origin = _U(components), (0.0,) * columns, (0.0,) * components

    # One function: Numba finds one that closes over another compiled function in no cache, and compiles it in every process.
    @_kernel
    def run(
        steps, last, begin, end, cells, sums, table, keep, depth, lag, tiles, runs, starts, ends, weight, stiff, directions, across
    ):  # fmt: skip
        for start in range(steps[0], steps[1], depth):
            deep = min(depth, steps[1] - start)
            for front in range(begin, end + (deep - 1) * lag):
                for behind in range(deep):
                    tile = front - behind * lag
                    if not begin <= tile < end:
                        continue
                    k = start + behind
                    old, now = cells[k % 2], cells[(k + 1) % 2]
                    low, high = runs[tiles[tile]], runs[tiles[tile + 1]]
                    count = _count(k, last)
                    if count:
                        for p in range(low, high):
                            for c in range(columns):
                                keep[p - low, c] = old[p, c]
                    to, of = old.reshape(-1), now.reshape(-1)
                    for r in range(tiles[tile], tiles[tile + 1]):
                        s = _U(starts[runs[r]])
                        neighbors = _U(starts[runs[r] + 1]) - s
                        for p in range(_U(runs[r]), _U(runs[r + 1])):
                            at = width * p
                            x, force = nothing, nothing
                            for c in range(columns):
                                x = tuple_setitem(x, c, of[at + _U(c)])
                            for _ in range(neighbors):
                                q = _U(ends[s])
                                if components == 1:
                                    for c in range(columns):
                                        force = tuple_setitem(force, c, force[c] + stiff[s] * (of[q + _U(c)] - x[c]))
                                    s += _U(1)
                                    continue
                                n = origin
                                for a in range(components):
                                    n = tuple_setitem(n, a, directions[slot * s + _U(a)])
                                for f in range(0, columns, components):
                                    apart, pull = origin, 0.0
                                    for a in range(components):
                                        apart = tuple_setitem(apart, a, of[q + _U(f + a)] - x[f + a])
                                        pull += n[a] * apart[a]
                                    if signed:
                                        pull *= stiff[s]
                                    for a in range(components):
                                        force = tuple_setitem(force, f + a, force[f + a] + n[a] * pull)
                                    if prestressed:
                                        for a in range(components):
                                            force = tuple_setitem(force, f + a, force[f + a] + across[s] * apart[a])
                                s += _U(1)
                            w = weight[p]
                            for c in range(columns):
                                if k == 1:
                                    to[at + _U(c)] = x[c] + 0.5 * w * force[c]
                                else:
                                    to[at + _U(c)] = w * force[c] + (2.0 * x[c] - to[at + _U(c)])
                    if count:
                        _add(low, high, keep, old, now, fields, sums, _terms(k, count, table))

    return run


@_kernel
def _add(low, high, keep, new, now, fields, sums, terms):
    components = new.shape[1] // fields
    for j in range(len(terms)):
        for r in range(fields):
            a0, a1, a2 = terms[j, 0, 0, r], terms[j, 1, 0, r], terms[j, 2, 0, r]
            b0, b1, b2 = terms[j, 0, 1, r], terms[j, 1, 1, r], terms[j, 2, 1, r]
            if a0 == 0 and a1 == 0 and a2 == 0 and b0 == 0 and b1 == 0 and b2 == 0:
                continue
            for p in range(low, high):
                for c in range(components):
                    q = r * components + c
                    t0, t1, t2 = keep[p - low, q], now[p, q], new[p, q]
                    sums[j, 0, p, c] += a0 * t0 + a1 * t1 + a2 * t2
                    sums[j, 1, p, c] += b0 * t0 + b1 * t1 + b2 * t2


@_kernel
def rows(
    steps, last, begin, end, cells, sums, table, pulls, force, keep, weight, neighbors, shifts, stiff, axes, parts,
    across, pad, components, wrap,
):  # fmt: skip
    """Some steps on rows begin to end - 1 of a lattice.

    Each loop runs along a row and writes one array: with more, the compiler's tests for overlapping arrays become so
    many that it gives up vectorizing.

    Args:
        steps, last, table: as for :func:`gathered`.
        cells: (2, field and component, row, width + 2 pad), T_k in cells[k % 2]; the pads hold copies of the other end,
            or walls at rest; the last row, beyond those of the lattice, is at rest.
        weight: (row, width).
        neighbors: of each row by each lattice step, (row, step); the second half of the steps are opposite to the first.
        shifts: along the row by each lattice step, (step,).
        stiff: k - T / L, (step, 1, 1) for equal bonds, else (step, row, width), zero where there is no bond.
        axes, parts: the two components of each step's direction that are not zero, (step, 2), and their values; the
            second value is zero where only one is not.
        across: T / L in the shape of ``stiff``; empty without tension.
        wrap: whether the rows are rings.
        pulls: scratch (step, width).
        force, keep: scratch (1, width).
        sums: (output, 2, component, row, width).
    """
    varied = stiff.shape[1] * stiff.shape[2] > 1
    half = len(shifts) // 2
    used = len(shifts) if varied else half
    force, keep = force[0], keep[0]
    width, fields = len(force), cells.shape[1] // components
    for k in range(steps[0], steps[1]):
        old, now = cells[k % 2], cells[(k + 1) % 2]
        count = _count(k, last)
        terms = _terms(k, count, table)
        for row in range(begin, end):
            for r in range(fields):
                base = components * r
                for s in range(used):
                    a, b = base + axes[s, 0], base + axes[s, 1]
                    x, y, there, shift = now[a, row], now[b, row], neighbors[row, s], pad + shifts[s]
                    x2, y2 = now[a, there, shift:], now[b, there, shift:]
                    m, n = parts[s, 0], parts[s, 1]
                    if varied and n == 0:
                        _pull_one(pulls[s], x[pad:], x2, stiff[s, row], m, width)
                    elif varied:
                        _pull_two(pulls[s], x[pad:], x2, y[pad:], y2, stiff[s, row], m, n, width)
                    else:
                        back, shift = neighbors[row, s + half], pad + shifts[s + half]
                        x3, y3, stiffness = now[a, back, shift:], now[b, back, shift:], stiff[s, 0, 0]
                        if n == 0:
                            _bend_one(pulls[s], x[pad:], x2, x3, stiffness * m, width)
                        else:
                            _bend_two(pulls[s], x[pad:], x2, x3, y[pad:], y2, y3, stiffness * m, stiffness * n, width)
                for c in range(components):
                    q = base + c
                    new, x = old[q, row], now[q, row]
                    force[:] = 0.0
                    for s in range(used):
                        for e in range(2):
                            if axes[s, e] == c and parts[s, e] != 0:
                                _scale_add(force, pulls[s], parts[s, e], width)
                    if len(across):
                        for s in range(used):
                            x2 = now[q, neighbors[row, s], pad + shifts[s] :]
                            if varied:
                                _pull_across(force, x[pad:], x2, across[s, row], width)
                            else:
                                x3 = now[q, neighbors[row, s + half], pad + shifts[s + half] :]
                                _bend_across(force, x[pad:], x2, x3, across[s, 0, 0], width)
                    if count:
                        keep[:] = new[pad : pad + width]
                    _close(new[pad:], x[pad:], force, weight[row], width, k == 1)
                    if wrap:
                        for i in range(pad):
                            new[i] = new[width + i]
                            new[pad + width + i] = new[pad + i]
                    if count:
                        for j in range(len(terms)):
                            for kind in range(2):
                                f0, f1, f2 = terms[j, 0, kind, r], terms[j, 1, kind, r], terms[j, 2, kind, r]
                                if f0 != 0 or f1 != 0 or f2 != 0:
                                    _add_row(sums[j, kind, c, row], keep, x[pad:], new[pad:], f0, f1, f2, width)


@_kernel
def _pull_one(pull, x, x2, stiff, m, width):
    for i in range(_U(width)):
        pull[i] = stiff[i] * (m * (x2[i] - x[i]))


@_kernel
def _pull_two(pull, x, x2, y, y2, stiff, m, n, width):
    for i in range(_U(width)):
        pull[i] = stiff[i] * (m * (x2[i] - x[i]) + n * (y2[i] - y[i]))


@_kernel
def _bend_one(pull, x, x2, x3, m, width):
    for i in range(_U(width)):
        pull[i] = m * ((x2[i] - x[i]) + (x3[i] - x[i]))


@_kernel
def _bend_two(pull, x, x2, x3, y, y2, y3, m, n, width):
    for i in range(_U(width)):
        pull[i] = m * ((x2[i] - x[i]) + (x3[i] - x[i])) + n * ((y2[i] - y[i]) + (y3[i] - y[i]))


@_kernel
def _pull_across(force, x, x2, across, width):
    for i in range(_U(width)):
        force[i] += across[i] * (x2[i] - x[i])


@_kernel
def _bend_across(force, x, x2, x3, across, width):
    for i in range(_U(width)):
        force[i] += across * ((x2[i] - x[i]) + (x3[i] - x[i]))


@_kernel
def _scale_add(force, pull, m, width):
    for i in range(_U(width)):
        force[i] += m * pull[i]


@_kernel
def _close(new, now, force, weight, width, first):
    if first:
        for i in range(_U(width)):
            new[i] = now[i] + 0.5 * weight[i] * force[i]
    else:
        for i in range(_U(width)):
            new[i] = weight[i] * force[i] + (2.0 * now[i] - new[i])


@_kernel
def _add_row(total, keep, now, new, a, b, c, width):
    for i in range(_U(width)):
        total[i] += a * keep[i] + b * now[i] + c * new[i]


@_kernel
def grain_force(x, radii, pairs, shifts, hertz, modulus, damping, velocity, force):
    """Contact forces between grains at x, (particle, component), written to ``force``.

    Args:
        pairs: (pair, 2); the second grain is taken at its center plus the pair's shift (pair, component).
        damping: of the change of length of a closed contact; 0 for none.
    """
    d = x.shape[1]
    force[:] = 0.0
    for e in range(len(pairs)):
        i, j = pairs[e, 0], pairs[e, 1]
        square = 0.0
        for a in range(d):
            r = x[j, a] - x[i, a] + shifts[e, a]
            square += r * r
        touching = radii[i] + radii[j]
        if square >= touching * touching:
            continue
        length = np.sqrt(square)
        overlap = touching - length
        push = modulus * overlap
        if hertz:
            push *= np.sqrt(overlap) * (2.0 / 3.0)
        if damping > 0:
            rate = 0.0
            for a in range(d):
                rate += (velocity[j, a] - velocity[i, a]) * (x[j, a] - x[i, a] + shifts[e, a]) / length
            push -= damping * rate
        for a in range(d):
            f = push * (x[j, a] - x[i, a] + shifts[e, a]) / length
            force[i, a] -= f
            force[j, a] += f


@_kernel
def grain_steps(x, v, masses, radii, pairs, shifts, hertz, modulus, damping, step, count, origin, limit, force):
    """Velocity Verlet steps, at most ``count``, until a grain is ``limit`` away from ``origin``; how many were made.

    ``force`` holds that of the state at hand on entry and on return.
    """
    n, d = x.shape
    for made in range(count):
        far = 0.0
        for p in range(n):
            moved = 0.0
            for a in range(d):
                v[p, a] += 0.5 * step / masses[p] * force[p, a]
                x[p, a] += step * v[p, a]
                moved += (x[p, a] - origin[p, a]) ** 2
            far = max(far, moved)
        grain_force(x, radii, pairs, shifts, hertz, modulus, damping, v, force)
        for p in range(n):
            for a in range(d):
                v[p, a] += 0.5 * step / masses[p] * force[p, a]
        if far > limit * limit:
            return made + 1
    return count
