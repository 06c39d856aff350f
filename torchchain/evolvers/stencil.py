"""Chebyshev propagation with one chain kept in cache: the Numba kernels behind :mod:`chebyshev` and of fused observables.

A state at time t is a sum of Chebyshev polynomials T_k(x) of x = 1 - 2 A / W^2, A = -M^-1 K, applied to the state
(u, v) at an earlier *anchor*:

    u(t) = sum_k [c_k T_k u + s_k T_k v],    v(t) = sum_k [c_k T_k v + d_k T_k u],

with the coefficients of :mod:`.coefficients` at z = W (t - anchor). The outputs that follow an anchor closely form one
*segment* and share its T_k; the last of them is the next anchor.

On a uniform time grid the states mirrored about an anchor are at hand too, and then one recursion does for both:

    u(+t) = 2 sum_k c_k T_k u - u(-t),    v(+t) = v(-t) + 2 sum_k d_k T_k u.

Each row (one realization and one start) is treated by itself, in an order that depends on nothing but its own chain,
start and times: a row gives the same bits alone and in any batch, whatever the number of threads.

Importing this file imports Numba; :mod:`chebyshev` does it at the first use.
"""
# mypy: allow-untyped-defs

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from torchchain.evolvers import kernels
from torchchain.evolvers.coefficients import Tables, tabulate, top_order
from torchchain.evolvers.compiling import kernel
from torchchain.evolvers.expansion import LEAP, LONGEST, SHARED_PHASE
from torchchain.evolvers.records import BOND_MOMENTS, SITE_MOMENTS, mean_by_mass, record_fields, record_moments
from torchchain.evolvers.recursion import PAD, RING, Row, advance, aligned, clear, close, lay_out, trim, twice_energy

# The mirrored form adds up rounding errors like a random walk's integral; a plain step now and then ends that.
RESTART = 64
# Dropped at the edges of the active window: energy norm below half an ulp of the whole chain's.
TRIM = 2.0**-53
SLACK = 8.9e-16  # times closer than this, relative to themselves, count as equal on a uniform grid


@kernel
def reverse(values, last):
    """Turns values[: last + 1] around."""
    for j in range((last + 1) // 2):
        values[j], values[last - j] = values[last - j], values[j]


@kernel
def propagate(
    begin, end, masses, contacts, rigid_masses, frequencies, starts, periodic, times, tolerance, mirrored, kind,
    anchors, latest, clock, fields, moments, first,
):  # fmt: skip
    """Evolves rows begin to end - 1 through the times, each in cache from the first time to the last.

    Args:
        begin, end: rows; row r is start r % starts of realization r // starts.
        masses, contacts, rigid_masses, frequencies, starts, periodic, tolerance: see :class:`Rows`.
        times: (time,), increasing, not before the clock.
        mirrored: use the states mirrored about an anchor where the times form a uniform grid, and take times that
            are equal within rounding as equal. Without it the states do not depend on how the times are cut into
            calls, to the last bit.
        kind: STATES to KICKED_FIELDS.
        anchors, latest: states (row, 2, particle) at the last anchor and at the last time, updated unless ``latest``
            is empty, when these times are the only ones.
        clock: (row, 4): time of the anchor, times since it, last time, and twice the energy at the start (negative
            while unknown), updated.
        fields: (field, row - first, time, particle), written if the kind is one of states or fields.
        moments: (row - first, time, 3), total, center and width, written if the kind is one of moments.
        first: the row that comes first in ``fields`` or ``moments``.
    """
    n, steps = masses.shape[1], times.size
    slack = SLACK if mirrored else 0.0
    stride = 8 * ((n + 2 * PAD + 7) // 8)
    w = aligned((4 + RING + 2 * (LONGEST + 1)) * stride)
    ring = (4 + np.arange(RING)) * stride + PAD
    u = np.zeros(LONGEST + 1, np.int64)
    v = np.zeros(LONGEST + 1, np.int64)
    when = np.zeros(LONGEST + 1)  # the time of the state in rows u[j], v[j]

    longest_gap = times[0] - clock[begin, 2]
    for i in range(1, steps):
        longest_gap = max(longest_gap, times[i] - times[i - 1])
    top = top_order(1.001 * max(SHARED_PHASE, min(LEAP, frequencies.max() * longest_gap)))
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
    row = Row(n, periodic, True, PAD, stride + PAD, 2 * stride + PAD, 3 * stride + PAD, ring)
    frequency, stiff = 1.0, 1.0
    for r in range(begin, end):
        if r // starts != realization:
            realization = r // starts
            frequency = frequencies[realization]
            stiff = 0.25 * frequency * frequency
            even = lay_out(w, row, masses[realization], contacts[realization], stiff)
            row = Row(n, periodic, even, row.mass, row.contact, row.left, row.right, ring)
            tables.offsets[:] = -1.0
        clear(w, ring[0] - PAD, w.size)
        for j in range(LONGEST + 1):
            u[j] = (4 + RING + 2 * j) * stride + PAD
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
            clock[r, 3] = twice_energy(w, row, u[0], v[0])
        limit = TRIM * TRIM * clock[r, 3]
        # The motion as a whole is uniform.
        begun, moved = anchor, mean_by_mass(w, row, u[0], rigid_masses[realization])
        pace = mean_by_mass(w, row, v[0], rigid_masses[realization])
        low, high = trim(w, row, u[:1], v[:1], 1, stiff, limit, 0, n)
        start, stop = 0, n
        reference = 0.5 * (low + 1 + high)
        history = 0  # states on the grid before the anchor, in rows 1, 2, ...
        age = 0  # mirrored segments since the last plain one
        leaps = 0  # equal ones that are still to be made to the next time
        i = 0
        while i < steps:
            if since > 0 and (leaps > 0 or since >= LONGEST or frequency * (times[i] - anchor) > SHARED_PHASE):
                # The latest state becomes the anchor, and those before it follow in order.
                reverse(u, here)
                reverse(v, here)
                reverse(when, here)
                history = here if mirrored else 0
                low, high = trim(w, row, u, v, history + 1, stiff, limit, start, stop)
                anchor, since, here = when[0], 0, 0
            count = 1
            if leaps > 0 or since > 0 or times[i] > anchor:
                leaping = leaps > 0
                if not leaping:
                    while (
                        i + count < steps
                        and since + count < LONGEST
                        and frequency * (times[i + count] - anchor) <= SHARED_PHASE
                    ):
                        count += 1
                    # Counted down, not up to a time: the rounding of many sums would add up.
                    leaps = math.ceil(frequency * (times[i] - anchor) / LEAP)
                    leaping = leaps > 1
                    tabulate(tables, frequency, tolerance, anchor, times[i : i + count], leaps, slack)
                mirror = not leaping and count <= history and age < RESTART
                for j in range(count):
                    passed = anchor - when[j + 1]
                    mirror = mirror and abs(passed - tables.offsets[j]) <= slack * times[i + j]
                if periodic:
                    close(w, row, u[0])
                    close(w, row, v[0])
                start, stop = advance(w, row, u, v, low, high, count, tables, mirror)
                age = age + 1 if mirror else 0
                leaps -= 1
                for j in range(count):
                    when[j + 1] = (
                        anchor + tables.offsets[j] if leaps > 0 or (mirrored and not leaping) else times[i + j]
                    )
                since += count
                here = count
                if leaps > 0:
                    continue
            for j in range(count):
                at = j + 1 if since > 0 else 0
                if periodic:
                    close(w, row, u[at])
                away = moved + pace * (times[i + j] - begun)
                if kind in (SITE_MOMENTS, BOND_MOMENTS):
                    inner, outer = (start, stop) if since > 0 else (low, high)
                    reference = record_moments(
                        w, row, u[at], v[at], kind, inner, outer, reference, away, moments[r - first, i + j]
                    )
                else:
                    record_fields(w, row, u[at], v[at], kind, away, fields, r - first, i + j)
            i += count
        if latest.size == 0:
            continue
        anchors[r, 0], anchors[r, 1] = w[u[0] : u[0] + n], w[v[0] : v[0] + n]
        latest[r, 0], latest[r, 1] = w[u[here] : u[here] + n], w[v[here] : v[here] + n]
        clock[r, 0], clock[r, 1], clock[r, 2] = anchor, since, times[steps - 1]


@kernel
def squared_bounds(begin, end, masses, contacts, periodic, sweeps, bounds):
    """``Chain.squared_frequency_bound`` of realizations begin to end - 1, which in torch takes longer than a short run.

    Args:
        begin, end: realizations.
        masses, contacts, periodic: see :func:`propagate`.
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


@dataclass(frozen=True, eq=False)
class Rows:
    """Chains and their starts, laid out for the kernels.

    Attributes:
        masses: (realization, particle), float64.
        contacts: stiffness of contacts 0 to N, (realization, N + 1), float64; on a ring the last is the first again.
        rigid_masses: mass that moves as a whole, infinite between walls, (realization,), float64.
        frequencies: W, no less than any frequency of the chain, (realization,), float64.
        states: displacement and velocity, (row, 2, particle), float64; row r starts realization r // starts.
        starts: rows per realization.
        periodic: whether the chains are rings.
        tolerance: largest sum of dropped coefficients in a segment.
    """

    masses: np.ndarray
    contacts: np.ndarray
    rigid_masses: np.ndarray
    frequencies: np.ndarray
    states: np.ndarray
    starts: int
    periodic: bool
    tolerance: float

    @property
    def count(self) -> int:
        return len(self.states)


class Propagation:
    """Rows on their way through time; each call takes some of them to the next window of times.

    Args:
        rows: chains and starts.
        mirrored: see :func:`propagate`.
        once: there will be no second window, and nothing is kept for it.
    """

    def __init__(self, rows: Rows, mirrored: bool = False, once: bool = False) -> None:
        kernels.announce(propagate)
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
        propagate(
            begin, end, rows.masses, rows.contacts, rows.rigid_masses, rows.frequencies, rows.starts, rows.periodic, times,
            rows.tolerance, self.mirrored, kind, self.anchors, self.latest, self.clock, fields, moments, first,
        )  # fmt: skip
