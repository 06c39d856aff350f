"""The symplectic recursion on the CPU, one chain kept in the cache over all its steps; see :mod:`.symplectic`.

Imported on first use, because numba takes a while to load. Fields are padded with a ghost particle at each end, a
wall's (at rest) or the neighbor's across the seam, so that contact c joins entries c and c + 1 whatever the boundary.
"""

# mypy: allow-untyped-defs

from __future__ import annotations

from typing import Any

import numpy as np

from torchchain.evolvers import kernels
from torchchain.evolvers.compiling import kernel, summing_kernel
from torchchain.threads import side_by_side


@kernel
def _wrap(field, periodic):
    n = field.shape[0] - 2
    if periodic:
        field[0] = field[n]
        field[n + 1] = field[1]


@kernel
def _drift(displacement, velocity, duration, periodic):
    for i in range(displacement.shape[0]):
        displacement[i] += duration * velocity[i]
    _wrap(displacement, periodic)


@kernel
def _kick(displacement, velocity, duration, weight, stiffness, hertz, tension, peak, periodic):
    n = weight.shape[0]
    if hertz:
        one = weight.dtype.type(1)
        two_thirds = weight.dtype.type(2 / 3)
        three = weight.dtype.type(3)
        for c in range(n + 1):
            elongation = displacement[c + 1] - displacement[c]
            peak[c] = max(peak[c], elongation)
            closed = elongation if elongation < one else one
            q = closed / (one + np.sqrt(one - closed))
            tension[c] = stiffness[c] * two_thirds * q * (three - three * q + q * q)
        for i in range(n):
            velocity[i + 1] += duration * weight[i] * (tension[i + 1] - tension[i])
    else:
        for i in range(n):
            velocity[i + 1] += (
                duration
                * weight[i]
                * (
                    stiffness[i + 1] * (displacement[i + 2] - displacement[i + 1])
                    - stiffness[i] * (displacement[i + 1] - displacement[i])
                )
            )
    _wrap(velocity, periodic)


@summing_kernel
def _damp(displacement, velocity, duration, weight, damping, hertz, active, force, middle, periodic):
    """Contact damping over the duration by the explicit midpoint rule; returns the kinetic energy it takes."""
    n = weight.shape[0]
    half = weight.dtype.type(0.5)
    one = weight.dtype.type(1)
    zero = weight.dtype.type(0)
    if hertz:
        for c in range(n + 1):
            active[c] = damping[c] if displacement[c + 1] - displacement[c] < one else zero
    else:
        active = damping
    for c in range(n + 1):
        force[c] = active[c] * (velocity[c + 1] - velocity[c])
    for i in range(n):
        middle[i + 1] = velocity[i + 1] + half * duration * weight[i] * (force[i + 1] - force[i])
    _wrap(middle, periodic)
    for c in range(n + 1):
        force[c] = active[c] * (middle[c + 1] - middle[c])
    work = zero
    for i in range(n):
        pull = duration * (force[i + 1] - force[i])
        before = velocity[i + 1]
        after = before + weight[i] * pull
        velocity[i + 1] = after
        work += pull * half * (before + after)
    _wrap(velocity, periodic)
    return -work


@kernel
def _advance_row(
    displacement, velocity, peak, lost, weight, stiffness, damping, periodic, hertz, damped,
    opening, middle, closing, substeps, steps, displacements, velocities, losses, openings,
):  # fmt: skip
    n = weight.shape[0]
    u = np.zeros(n + 2, weight.dtype)
    v = np.zeros(n + 2, weight.dtype)
    u[1:-1] = displacement
    v[1:-1] = velocity
    _wrap(u, periodic)
    _wrap(v, periodic)
    tension = np.zeros(n + 1, weight.dtype)
    active = np.zeros(n + 1, weight.dtype)
    relaxed = np.zeros(n + 2, weight.dtype)
    half = weight.dtype.type(0.5)
    for t in range(substeps.shape[0]):
        h = steps[t]
        if substeps[t] > 0:
            if damped:
                lost += _damp(u, v, half * h, weight, damping, hertz, active, tension, relaxed, periodic)
            for step in range(substeps[t]):
                last = step + 1 == substeps[t]
                # Without damping between them, the end of a step and the start of the next are one drift and one kick.
                if step == 0 or damped:
                    if opening[0] != 0:
                        _drift(u, v, opening[0] * h, periodic)
                    if opening[1] != 0:
                        _kick(u, v, opening[1] * h, weight, stiffness, hertz, tension, peak, periodic)
                for k in range(middle.shape[0]):
                    _drift(u, v, middle[k, 0] * h, periodic)
                    _kick(u, v, middle[k, 1] * h, weight, stiffness, hertz, tension, peak, periodic)
                drift, kick = closing[0], closing[1]
                if not (last or damped):
                    drift += opening[0]
                    kick += opening[1]
                _drift(u, v, drift * h, periodic)
                if kick != 0:
                    _kick(u, v, kick * h, weight, stiffness, hertz, tension, peak, periodic)
                if damped:
                    duration = half * h if last else h
                    lost += _damp(u, v, duration, weight, damping, hertz, active, tension, relaxed, periodic)
        displacements[t] = u[1:-1]
        velocities[t] = v[1:-1]
        losses[t] = lost
        if hertz:
            count = 0
            for c in range(n if periodic else n + 1):
                peak[c] = max(peak[c], u[c + 1] - u[c])
                count += peak[c] >= 1
            openings[t] = count
    displacement[:] = u[1:-1]
    velocity[:] = v[1:-1]
    return lost


@kernel
def _advance_rows(
    begin, end, displacement, velocity, peak, lost, weight, stiffness, damping, periodic, hertz, damped,
    opening, middle, closing, substeps, steps, displacements, velocities, losses, openings,
):  # fmt: skip
    members = displacement.shape[0] // weight.shape[0]
    for row in range(begin, end):
        chain = row // members
        lost[row] = _advance_row(
            displacement[row], velocity[row], peak[row], lost[row], weight[chain], stiffness[chain], damping[chain],
            periodic, hertz, damped, opening, middle, closing, substeps[row], steps[row],
            displacements[row], velocities[row], losses[row], openings[row],
        )  # fmt: skip


def advance_rows(*arguments: Any) -> None:
    """Advance every row in place and fill its outputs, on as many threads as torch uses.

    Args:
        arguments: displacement and velocity (row, particle), peak elongation (row, contact + 1) and energy lost
            (row,), all updated; weight 1/m (chain, particle), stiffness and damping (chain, contact + 1), a periodic
            chain's contact 0 being repeated at the end; the flags periodic, hertz and damped; the composition's
            opening (2,), middle (stage, 2) and closing (2,) drifts and kicks; substeps and their length (row, time);
            the outputs displacement and velocity (row, time, particle), energy lost and openings (row, time).
    """
    kernels.announce(_advance_rows)
    # Python's own threads, as the loop holds no lock: numba's may not be called from several of them at once.
    side_by_side(lambda begin, end: _advance_rows(begin, end, *arguments), len(arguments[0]))
