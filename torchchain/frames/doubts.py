"""What makes a result doubtful: warnings of one line with file, frame and field."""

from __future__ import annotations

import math
import sys
import warnings

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.frames.record import AXES, Frame, FramesWarning
from torchchain.network import Network

CHANGED = 0.01  # share of the energy that an undamped run may gain or lose before a warning
NOISE = 1e-3  # share of the displacement that the digits of the positions may leave out


def warn(field: str, words: str) -> None:
    """A warning of one line that begins with file, frame and field, shown at the caller's line."""
    level, caller = 2, sys._getframe(1)
    while caller.f_back is not None and caller.f_globals.get("__name__", "").startswith("torchchain."):
        level, caller = level + 1, caller.f_back
    warnings.warn(FramesWarning(" ".join(f"{field}: {words}".split())), stacklevel=level)


def significant_digits(values: Tensor) -> int:
    """Decimal digits after which all values end, 5 to 12; 16 if they have more."""
    values = values[values != 0].abs()
    if not len(values):
        return 16
    rounding = 8 * torch.finfo(values.dtype).eps * values.max()
    for digits in range(5, 13):
        unit = 10.0 ** (values.log10().floor() - digits + 1)
        if bool((((values / unit).round() * unit - values).abs() <= rounding).all()):
            return digits
    return 16


def check_digits(frame: Frame, axes: list[str], moved: Tensor, length: float) -> None:
    """A warning where the digits of the positions, or of their share of the box, are too few for the displacements."""
    for column, axis in enumerate(axes):
        size = float(moved[..., column].square().mean().sqrt()) * length
        if not size > 0:
            continue
        positions = frame.positions[:, frame.axes.index(axis)] * length
        written = [(positions, 1.0)]
        if frame.box is not None:
            i = AXES.index(axis)
            low, side = frame.box.lower[i] * length, float(frame.box.lengths[i]) * length
            written += [((positions - low) / side, side)] if side > 0 else []
        for values, scale in written:
            digits, largest = significant_digits(values), float(values.abs().max())
            if digits > 12 or largest == 0:
                continue
            step = scale * 10.0 ** (math.floor(math.log10(largest)) - digits + 1)
            error = step / math.sqrt(12)  # of a value that is rounded, rms
            if error > NOISE * size:
                warn(
                    frame.at(axis),
                    f"positions of {digits} digits, in steps of {step / length:.2g}, for displacements of {size / length:.2g} (rms): off by {error / size:.1g} of themselves"
                    " (LAMMPS: dump_modify ... format float %.15g)",
                )
                return


def check_bounds(frame: Frame, axis: str, moved: Tensor, length: float) -> None:
    """A warning where particles crossed a box whose bounds are rounded to six digits, as LIGGGHTS writes them."""
    if frame.box is None:
        return
    size, i = float(moved.square().mean().sqrt()) * length, AXES.index(axis)
    for bound in (frame.box.lower[i] * length, frame.box.upper[i] * length):
        # Fewer digits are a round number, more are not rounded.
        if f"{bound:.6g}" == f"{bound:.12g}" != f"{bound:.5g}":
            error = 0.5 * 10.0 ** (math.floor(math.log10(abs(bound))) - 5)
            if error > NOISE * size:
                warn(
                    frame.at("box"),
                    f"the bound {bound / length:.6g} along {axis} has six digits: if it is rounded, displacements beyond it are off by up to {error / size:.1g} of their size {size / length:.2g} (dump {axis}u)",
                )
                return


def check_across(frame: Frame, axis: str) -> None:
    """A warning for motion across the axis of a chain."""
    if frame.velocities is None or len(frame.axes) < 2:
        return
    square = frame.velocities.square().sum(0)
    along, total = float(square[frame.axes.index(axis)]), float(square.sum())
    if total > 0 and total - along > 1e-6 * total:
        warn(
            frame.at("velocities"),
            f"{(total - along) / total:.2g} of the squares are across the chain's axis {axis}, and are left out",
        )


def check_energy(name: str, chain: Chain | Network, path: Trajectory) -> None:
    """A warning for a motion that the chain, or network, does not make: energy that drifts without damping; an error for
    one that more than doubles its energy, which no chain does by itself.

    Args:
        name: of the file or run, for the warning.
        chain: in the units of the trajectory.
        path: (*any, time, particle), of a network (*any, time, particle, component).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(32, 1, 0)[0])
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=3), [0.0, 10.0], method="modes")
        >>> tc.frames.check_energy("run.dump", chain, path)  # energy is kept: no warning
    """
    if chain.is_damped:
        return
    kind = "network" if isinstance(chain, Network) else "chain"
    total = chain.energy(path.displacement, path.velocity).detach().reshape(-1, len(path.times))
    start = total[:, :1]
    change = torch.where(start > 0, total / start - 1, 0.0)
    worst = int(change.abs().argmax())
    run, k = divmod(worst, len(path.times))
    field, words = f"{name}, frame {k + 1}: energy", f"{1 + float(change[run, k]):.4g} of that of frame 1"
    if float(change[run, k]) > 1:
        reasons = f"a kick after it, or another stiffness, or units, than the {kind}'s"
        raise checks.fail(field, "be that of the first frame", f"{words}: {reasons}")
    if abs(float(change[run, k])) > CHANGED:
        warn(
            field,
            f"{words}, for a {kind} without damping: damping or too long a time step there, or another stiffness than the {kind}'s",
        )


def check_opening(name: str, chain: Chain, path: Trajectory) -> None:
    """A warning for contacts that open; arguments as for :func:`check_energy`, (time, particle).

    Example:
        >>> chain = tc.Chain([1.0, 1.0, 1.0])
        >>> path = tc.evolve(chain, tc.impulse(chain, site=2, velocity=0.01), [0.0, 1.0], method="modes")
        >>> tc.frames.check_opening("run.dump", chain, path)  # stretched by 0.006, the overlap being 1: no warning
    """
    stretch = chain.elongation(path.displacement)
    if float(stretch.max()) >= 1:
        k = int(stretch.amax(-1).argmax())
        warn(
            f"{name}, frame {k + 1}: displacement",
            f"above the overlap: a contact is stretched by {float(stretch.max()):.3g}, its initial overlap being 1 in the library's units",
        )
