"""What a chain on its way through time leaves behind at every output time. Imports Numba."""
# mypy: allow-untyped-defs

from __future__ import annotations

import math

import numpy as np

from torchchain.evolvers.compiling import U, kernel, summing_kernel, wide_vectors

# States; sums over particles of energy; the fields whose transforms make the energy of a wavenumber.
STATES, SITE_MOMENTS, BOND_MOMENTS, UNIFORM_FIELDS, SITE_FIELDS, BOND_FIELDS, KICKED_FIELDS = range(7)


@summing_kernel
def mean_by_mass(w, row, at, rigid_mass):
    """The mean of a row of the scratch by mass: how far, or how fast, the chain moves as a whole; 0 between walls."""
    total = 0.0
    for p in range(row.n):
        total += w[row.mass + p] * w[at + p]
    return total / rigid_mass


@summing_kernel
def _moments_site(w, u, v, mass, contact, reference, first, moved, n):
    """Sums of E, q E and q^2 E over n particles, E of Eq. 36 and q the particle number minus the reference.

    Displacements are counted from how far the chain has moved as a whole.
    """
    wide_vectors()
    p, s, b, k, one = U(u), U(v), U(mass), U(contact), U(1)
    total, center, width = 0.0, 0.0, 0.0
    q = first - reference
    for i in range(U(n)):
        x, y = w[p + i], w[s + i]
        pull = w[k + i] * (x - w[p + i - one]) + w[k + i + one] * (x - w[p + i + one])
        energy = w[b + i] * y * y + (x - moved) * pull
        number = q + np.float64(np.int64(i))
        total += energy
        center += number * energy
        width += number * number * energy
    return 0.5 * total, 0.5 * center, 0.5 * width


@summing_kernel
def _moments_bond(w, u, v, mass, contact, reference, first, n):
    """The same with E of Eq. A3; the other half of a wall contact is added by the caller."""
    wide_vectors()
    p, s, b, k, one = U(u), U(v), U(mass), U(contact), U(1)
    total, center, width = 0.0, 0.0, 0.0
    q = first - reference
    for i in range(U(n)):
        x, y = w[p + i], w[s + i]
        left, right = x - w[p + i - one], w[p + i + one] - x
        energy = w[b + i] * y * y + 0.5 * (w[k + i] * left * left + w[k + i + one] * right * right)
        number = q + np.float64(np.int64(i))
        total += energy
        center += number * energy
        width += number * number * energy
    return 0.5 * total, 0.5 * center, 0.5 * width


@kernel
def _wall_moments(w, row, u, reference):
    """What :func:`_moments_bond` leaves out: a wall contact belongs as a whole to its one particle."""
    first, last = w[u], w[u + row.n - 1]
    e0 = 0.25 * w[row.contact] * first * first
    e1 = 0.25 * w[row.contact + row.n] * last * last
    q0, q1 = 1.0 - reference, row.n - reference
    return e0 + e1, q0 * e0 + q1 * e1, q0 * q0 * e0 + q1 * q1 * e1


@kernel
def record_moments(w, row, u, v, kind, low, high, reference, moved, out):
    """Leaves total, center and width of one state's energy behind.

    Returns:
        The reference for the next state's moments, the particle at this center: the width must not come out as
        a small difference of large numbers.
    """
    # The particles at rest beyond the window have half of its outermost contacts, and feel their pull.
    if row.periodic and (low == 0 or high == row.n):
        low, high = 0, row.n
    low, high = max(low - 1, 0), min(high + 1, row.n)
    size = high - low
    if kind == SITE_MOMENTS:
        total, first, second = _moments_site(
            w, u + low, v + low, row.mass + low, row.contact + low, reference, low + 1.0, moved, size
        )
    else:
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


@kernel
def record_fields(w, row, u, v, kind, moved, out, r, i):
    """Leaves one state, or the fields that make up its energy in wavenumber space, in out[:, r, i]."""
    wide_vectors()
    # One field a loop: with more pointers in one, the compiler gives up proving that they are apart.
    n, one = U(row.n), U(1)
    p, s, b, k = U(u), U(v), U(row.mass), U(row.contact)
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
    if kind == STATES:
        for q in range(n):
            displacement[q] = w[p + q]
        return
    if kind == KICKED_FIELDS:  # velocities after a kick, of which the motion as a whole is one
        moved = 0.0
    for q in range(n):
        displacement[q] = w[p + q] - moved
    for q in range(n):
        second[q] = w[b + q] * w[s + q]
    if kind == KICKED_FIELDS:
        momentum = out[3, r, i]
        for q in range(n):
            momentum[q] = w[b + q] * w[p + q]
    if kind == SITE_FIELDS:
        pull = out[3, r, i]
        for q in range(n):
            x = w[p + q]
            pull[q] = w[k + q] * (x - w[p + q - one]) + w[k + q + one] * (x - w[p + q + one])
