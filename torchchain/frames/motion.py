"""From frames to chains: the order along an axis, displacements from a reference, masses and contacts."""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.frames.record import AXES, Box, Contacts, Frame, FramesWarning
from torchchain.memory import gigabytes, memory

LAWS = ("linear", "hertz")
DRIFT = 0.01  # share of the energy that an undamped run may gain or lose before a warning
FAR = 0.1  # of a mean mass from 1
NOISE = 1e-3  # share of the displacement that the digits of the positions may leave out


def warn(field: str, words: str) -> None:
    """A warning of one line that begins with file, frame and field, shown at the caller's line."""
    level, caller = 2, sys._getframe(1)
    while caller.f_back is not None and caller.f_globals.get("__name__", "").startswith("torchchain."):
        level, caller = level + 1, caller.f_back
    warnings.warn(FramesWarning(" ".join(f"{field}: {words}".split())), stacklevel=level)


def here(name: str, frame: Frame) -> str:
    """File and frame, as errors begin."""
    return f"{name}, frame {frame.number}"


def line_axis(name: str, frame: Frame, axis: str | None) -> str | None:
    """The axis of the chain: the one given, or the one on which the particles form a line; None if they form none.

    They form one where none is farther from the first, across the axis, than half their mean distance along it.
    """
    if axis is not None:
        checks.choice("axis", axis, (*AXES, "all"))
        if axis != "all" and axis not in frame.axes:
            raise checks.fail(
                f"{here(name, frame)}: {axis}", "be in the file for this axis", f"only {', '.join(frame.axes)}"
            )
        return None if axis == "all" else axis
    if len(frame.axes) == 1:
        return frame.axes[0]
    offset = frame.positions - frame.positions[:1]
    if frame.box is not None:
        for i, a in enumerate(frame.axes):
            length = float(frame.box.lengths[AXES.index(a)])
            if frame.box.periodic[AXES.index(a)] and length > 0:
                across = offset[:, i]
                offset[:, i] = across - length * (across / length).round()
    for i, a in enumerate(frame.axes):
        along = frame.positions[:, i]
        spacing = float(along.max() - along.min()) / max(1, len(along) - 1)
        others = [j for j in range(len(frame.axes)) if j != i]
        if spacing > 0 and float(offset[:, others].abs().max()) < spacing / 2:
            return a
    return None


def line_order(name: str, frame: Frame, axis: str) -> Tensor:
    """Places of the particles in ascending order along an axis, (particle,).

    On a periodic axis the order begins at the box's lower bound, unless the ids show where: if they ascend around
    the ring, it begins with the lowest.
    """
    column = frame.axes.index(axis)
    along = frame.positions[:, column]
    if frame.box is not None and frame.box.periodic[AXES.index(axis)] and not frame.unwrapped[column]:
        low, length = frame.box.lower[AXES.index(axis)], float(frame.box.lengths[AXES.index(axis)])
        if length > 0:
            along = low + (along - low).remainder(length)
    sorted_along, order = along.sort(stable=True)
    same = (sorted_along.diff() == 0).nonzero()
    if len(same):
        a, b = order[int(same[0])], order[int(same[0]) + 1]
        raise checks.fail(
            f"{here(name, frame)}: {axis}",
            "differ from particle to particle along the chain",
            f"{along[a]:g} for ids {int(frame.ids[a])} and {int(frame.ids[b])}",
        )
    begin = int(order.argmin())
    rolled = order.roll(-begin)
    return rolled if bool((rolled.diff() > 0).all()) else order


def check_contact_order(name: str, frame: Frame, order: Tensor, axis: str) -> None:
    """An error for a contact between particles that are not neighbors along the chain."""
    if frame.contacts is None:
        return
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    pairs = frame.contacts.pairs[(frame.contacts.pairs >= 0).all(-1)]
    apart = (place[pairs[:, 0]] - place[pairs[:, 1]]).abs()
    bad = (apart != 1) & (apart != len(order) - 1)
    if bool(bad.any()):
        a, b = (int(frame.ids[i]) for i in pairs[int(bad.nonzero()[0])])
        raise checks.fail(
            f"{here(name, frame)}: contacts", f"join neighbors along {axis} for a chain", f"one of ids {a} and {b}"
        )


def displacements(
    name: str,
    frames: Iterable[Frame],
    n_frames: int,
    first: Frame,
    reference: Frame,
    reference_name: str,
    axis: str | None,
    length: float,
) -> Trajectory:
    """Displacements from a reference, and velocities; see :meth:`Frames.trajectory`."""
    _check_alike(name, first, reference, reference_name)
    line = line_axis(name, first, axis)
    columns = list(range(len(first.axes))) if line is None else [first.axes.index(line)]
    order = torch.arange(len(first.ids)) if line is None else line_order(name, first, line)
    if line is not None:
        check_contact_order(name, first, order, line)
    size = 16 * n_frames * len(order) * len(columns)
    limit = memory(torch.device("cpu"))
    if size > limit:
        raise checks.fail(
            f"{name}: frames",
            f"fit into the {gigabytes(limit)} of memory of this machine (take fewer, as in frames[::10])",
            f"{gigabytes(size)} of displacements and velocities",
        )
    shape = (n_frames, len(order), len(columns))
    moved, velocity = torch.empty(shape, dtype=torch.float64), torch.empty(shape, dtype=torch.float64)
    times = torch.empty(n_frames, dtype=torch.float64)
    rest = reference.positions[order][:, columns]
    wraps = [
        _period(reference.box, first.axes[c]) if not (first.unwrapped[c] and reference.unwrapped[c]) else 0.0
        for c in columns
    ]
    before = torch.zeros_like(rest)
    last, numbers = first, []
    for k, frame in enumerate(frames):
        if frame.velocities is None:
            raise checks.fail(
                f"{here(name, frame)}: velocities",
                f"be in the file (columns {' '.join('v' + a for a in frame.axes)})",
                "none",
            )
        if frame.time is None:
            raise checks.fail(
                f"{here(name, frame)}: TIME",
                "be in the file (LAMMPS: dump_modify ... time yes) or follow from time_step=",
                "none",
            )
        u = frame.positions[order][:, columns] - rest
        for i, (column, side) in enumerate(zip(columns, wraps, strict=True)):
            if side:
                _check_box(name, frame, reference, first.axes[column])
                u[:, i] -= side * ((u[:, i] - before[:, i]) / side).round()
            elif frame.box is not None and not frame.unwrapped[column]:
                _check_jump(name, frame, u[:, i], first.axes[column])
        times[k], moved[k], velocity[k], before = frame.time, u, frame.velocities[order][:, columns], u
        last = frame
        numbers.append(frame.number)
    _check_digits(name, last, [first.axes[c] for c in columns], moved, length)
    if line is not None:
        _check_line(name, numbers, moved[..., 0], first, reference, order, line)
        _check_across(name, last, line)
        moved, velocity = moved[..., 0], velocity[..., 0]
    return Trajectory(times - times[0], moved, velocity)


def _period(box: Box | None, axis: str) -> float:
    i = AXES.index(axis)
    return float(box.lengths[i]) if box is not None and box.periodic[i] else 0.0


def _check_alike(name: str, first: Frame, reference: Frame, reference_name: str) -> None:
    """An error unless the reference has the same particles and axes."""
    where = here(reference_name, reference)
    if reference.axes != first.axes:
        raise checks.fail(
            f"{where}: positions", f"be along {', '.join(first.axes)} as in {name}", ", ".join(reference.axes)
        )
    if len(reference.ids) != len(first.ids) or not torch.equal(reference.ids, first.ids):
        raise checks.fail(
            f"{where}: ids",
            f"be those of {name}",
            f"{len(reference.ids)} particles against {len(first.ids)}"
            if len(reference.ids) != len(first.ids)
            else "others",
        )
    for field in ("masses", "radii"):
        a, b = getattr(reference, field), getattr(first, field)
        if a is not None and b is not None and not torch.equal(a, b):
            bad = int((a != b).nonzero()[0])
            raise checks.fail(
                f"{where}: {field}",
                f"be those of {name}",
                f"{a[bad]:g} against {b[bad]:g} for id {int(first.ids[bad])}",
            )


def _check_box(name: str, frame: Frame, reference: Frame, axis: str) -> None:
    now, then = _period(frame.box, axis), _period(reference.box, axis)
    if abs(now - then) > 1e-6 * then:
        raise checks.fail(
            f"{here(name, frame)}: box",
            f"keep its length {then:g} along {axis} for positions that wrap (or dump {axis}u)",
            f"{now:g}",
        )


def _check_jump(name: str, frame: Frame, u: Tensor, axis: str) -> None:
    """An error for a particle that seems to have crossed a box that is not marked as periodic."""
    assert frame.box is not None
    length = float(frame.box.lengths[AXES.index(axis)])
    if length > 0 and bool((u.abs() > 0.9 * length).any()):
        bad = int(u.abs().argmax())
        raise checks.fail(
            f"{here(name, frame)}: {axis}",
            'stay on one side of a box that is not marked periodic (periodic="x" marks it)',
            f"a step of {float(u[bad]):g} for id {int(frame.ids[bad])}",
        )


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


def _check_digits(name: str, frame: Frame, axes: list[str], moved: Tensor, length: float) -> None:
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
                    f"{here(name, frame)}: {axis}",
                    f"positions of {digits} digits, in steps of {step / length:.2g}, for displacements of {size / length:.2g} (rms): off by {error / size:.1g} of themselves"
                    " (LAMMPS: dump_modify ... format float %.15g)",
                )
                return


def _check_line(
    name: str, numbers: list[int], moved: Tensor, first: Frame, reference: Frame, order: Tensor, axis: str
) -> None:
    """An error for neighbors that passed each other, a warning for contacts that opened.

    Args:
        name: of the file.
        numbers: of the frames.
        moved: displacements along the axis, (time, particle).
        first, reference: the first frame and the state at rest.
        order: of the chain.
        axis: of the chain.
    """
    rest, ids = reference.positions[order, first.axes.index(axis)], first.ids[order].tolist()
    period = _period(reference.box, axis)
    n = len(order)
    gap, stretch = rest.diff(), moved.diff(dim=-1)
    if period:
        gap = (rest.roll(-1) - rest).remainder(period)
        stretch = moved.roll(-1, -1) - moved
    wrong = (
        gap <= 0 if not period else torch.full_like(gap, abs(float(gap.sum()) - period) > period / 2, dtype=torch.bool)
    )
    if bool(wrong.any()):
        raise checks.fail(f"{name}: {axis}", "have the order of the reference in the first frame", "another order")
    crossed = gap + stretch <= 0
    if bool(crossed.any()):
        k, c = (int(i) for i in crossed.nonzero()[0])
        raise checks.fail(
            f"{name}, frame {numbers[k]}: {axis}",
            "keep the order of the chain",
            f"ids {ids[c]} and {ids[(c + 1) % n]} past each other",
        )
    radii = reference.radii if reference.radii is not None else first.radii
    if radii is None:
        return
    radii = radii[order]
    overlap = (radii + radii.roll(-1))[: len(gap)] - gap
    apart = (overlap[: n - 1] <= 0).nonzero()  # the two ends may be
    if len(apart):
        c = int(apart[0])
        warn(
            f"{here(name, reference)}: radius",
            f"ids {ids[c]} and {ids[c + 1]} do not touch in the reference, by {-float(overlap[c]):.3g}",
        )
        return
    opened = (stretch >= overlap) & (overlap > 0)
    if bool(opened.any()):
        k, c = (int(i) for i in opened.nonzero()[0])
        warn(
            f"{name}, frame {numbers[k]}: {axis}",
            f"displacements above the overlap: the contact of ids {ids[c]} and {ids[(c + 1) % n]} opened (stretched by {float(stretch[k, c]):.3g}, overlap {float(overlap[c]):.3g})",
        )


def _check_across(name: str, frame: Frame, axis: str) -> None:
    if frame.velocities is None or len(frame.axes) < 2:
        return
    square = frame.velocities.square().sum(0)
    along, total = float(square[frame.axes.index(axis)]), float(square.sum())
    if total > 0 and total - along > 1e-6 * total:
        warn(
            f"{here(name, frame)}: velocities",
            f"{(total - along) / total:.2g} of the squares are across the chain's axis {axis}, and are left out",
        )


@dataclass(frozen=True)
class ContactUnits:
    """Units in which the mean mass, the mean contact stiffness and the mean overlap are 1.

    Has ``unit(quantity)`` like :class:`torchchain.Scaling`.

    Attributes:
        mass, stiffness, length: in the file's units; positive.
    """

    mass: float
    stiffness: float
    length: float

    def __post_init__(self) -> None:
        for field in ("mass", "stiffness", "length"):
            object.__setattr__(self, field, checks.number(f"units.{field}", getattr(self, field), above=0.0))

    def unit(self, quantity: str) -> float:
        """The file's value of the dimensionless 1 of a quantity."""
        time = math.sqrt(self.mass / self.stiffness)
        known = {
            "time": time, "length": self.length, "velocity": self.length / time, "mass": self.mass, "stiffness": self.stiffness,
            "force": self.stiffness * self.length, "energy": self.stiffness * self.length**2,
        }  # fmt: skip
        return known[checks.choice("quantity", quantity, known)]


def contact_stiffness(name: str, frame: Frame, law: str) -> Tensor:
    """Slope of the force at each contact of the frame, (contact,): F / overlap, or (3/2) F / overlap of a Hertz contact."""
    checks.choice("law", law, LAWS)
    contacts = frame.contacts
    if contacts is None:
        raise checks.fail(
            f"{here(name, frame)}: contacts",
            "be read with the frames (read_frames(..., contacts=)) for their stiffness",
            "none",
        )
    for field in ("overlap", "normal_force"):
        values = getattr(contacts, field)
        if values is None:
            raise checks.fail(f"{here(name, frame)}: {field}", "be in the contact list for its stiffness", "none")
        if bool((values <= 0).any()):
            raise checks.fail(
                f"{here(name, frame)}: {field}",
                "be positive at every contact for its stiffness",
                f"{float(values[values <= 0][0]):g}",
            )
    assert contacts.overlap is not None
    assert contacts.normal_force is not None
    return (1.5 if law == "hertz" else 1.0) * contacts.normal_force / contacts.overlap


def fit_units(name: str, frame: Frame, law: str) -> ContactUnits:
    """Units from the masses and contacts of a frame at rest; see :meth:`Frames.fit_units`."""
    stiffness = contact_stiffness(name, frame, law)
    masses = finite_masses(name, frame)
    assert frame.contacts is not None
    assert frame.contacts.overlap is not None
    if not len(stiffness):
        raise checks.fail(f"{here(name, frame)}: contacts", "be at least one for units", "none")
    return ContactUnits(float(masses.mean()), float(stiffness.mean()), float(frame.contacts.overlap.mean()))


def finite_masses(name: str, frame: Frame) -> Tensor:
    """The masses, (particle,); an error that says where they could come from if there are none."""
    if frame.masses is None:
        raise checks.fail(
            f"{here(name, frame)}: masses",
            "be in the file (LAMMPS: the column mass; MercuryDPM: the .restart beside it) or be given by masses= or, with radii, density=", "none",
        )  # fmt: skip
    fixed = frame.masses.isinf()
    if bool(fixed.any()):
        raise checks.fail(
            f"{here(name, frame)}: masses",
            "be finite (leave out fixed particles with frames.select)",
            f"a fixed particle, id {int(frame.ids[fixed][0])}",
        )
    return frame.masses


def chain(
    name: str, frame: Frame, boundary: str, stiffness: Any, axis: str | None, contact: str, damping: Any
) -> Chain:
    """The chain of a frame; see :meth:`Frames.chain`."""
    line = line_axis(name, frame, axis)
    if line is None:
        raise checks.fail(
            f"{here(name, frame)}: positions",
            "lie on a line along an axis for a chain (or name it: axis='x')",
            f"{len(frame.ids)} particles that do not",
        )
    order = line_order(name, frame, line)
    check_contact_order(name, frame, order, line)
    masses = finite_masses(name, frame)[order]
    n = len(masses)
    if n < 2:
        raise checks.fail(f"{here(name, frame)}: ids", "be at least 2 for a chain", n)
    mean, spread = float(masses.mean()), float(masses.std()) / math.sqrt(n)
    if abs(mean - 1) > max(FAR, 4 * spread):
        warn(
            f"{here(name, frame)}: masses",
            f"their mean is {mean:.4g}, not 1: times are in other units than the library's (frames.scaled gives those)",
        )
    checks.choice("boundary", boundary, ("periodic", "fixed"))
    periodic = frame.box is not None and frame.box.periodic[AXES.index(line)]
    if boundary == "periodic" and frame.box is not None and not periodic:
        warn(f"{here(name, frame)}: box", f"not marked periodic along {line}, but the chain is to be")
    if isinstance(stiffness, str):
        stiffness = _from_contacts(name, frame, stiffness, order, boundary)
    return Chain(masses, boundary, stiffness, contact, damping)


def _from_contacts(name: str, frame: Frame, law: str, order: Tensor, boundary: str) -> Tensor:
    """The stiffness of every contact in the order of the chain's, (contact,)."""
    if law not in LAWS:
        raise checks.fail("stiffness", "be a number, a tensor (contact,), 'linear' or 'hertz'", repr(law))
    values = contact_stiffness(name, frame, law)
    contacts = frame.contacts
    assert contacts is not None
    n = len(order)
    place = torch.empty_like(order)
    place[order] = torch.arange(n)
    found = torch.full((n + 1,), torch.nan, dtype=torch.float64)
    for (a, b), value in zip(contacts.pairs.tolist(), values.tolist(), strict=True):
        if a < 0 or b < 0:
            at = 0 if int(place[max(a, b)]) == 0 else n
        else:
            low, high = sorted((int(place[a]), int(place[b])))
            at = high if high - low == 1 and not (n == 2 and not math.isnan(float(found[1]))) else 0
        if not math.isnan(float(found[at])):
            raise checks.fail(
                f"{here(name, frame)}: contacts", "be one between two neighbors", f"a second one at contact {at + 1}"
            )
        found[at] = value
    found = found[:n] if boundary == "periodic" else found
    if bool(found.isnan().any()):
        raise checks.fail(
            f"{here(name, frame)}: contacts",
            f"be {len(found)}, one between any two neighbors{' and one with each wall' if boundary == 'fixed' else ''}",
            f"none at contact {int(found.isnan().nonzero()[0]) + 1}",
        )
    return found


def check_energy(name: str, chain: Chain, path: Trajectory) -> None:
    """Warnings for a motion that the chain does not make: energy that drifts without damping, contacts that open.

    Args:
        name: of the file, for the warnings.
        chain: in the units of the trajectory.
        path: (time, particle).
    """
    kinetic = (chain.masses * path.velocity.square()).sum(-1) / 2
    total = kinetic + chain.contact_energy(path.displacement).sum(-1)
    start = float(total[0])
    if not chain.is_damped and start > 0:
        change = (total / start - 1).abs()
        if float(change.max()) > DRIFT:
            k = int(change.argmax())
            warn(
                f"{name}, frame {k + 1}: energy",
                f"{float(total[k] / start):.4g} of that of frame 1, for a chain without damping: damping or too long a time step there, or another stiffness than the chain's",
            )
    stretch = chain.elongation(path.displacement)
    if float(stretch.max()) >= 1:
        k = int(stretch.amax(-1).argmax())
        warn(
            f"{name}, frame {k + 1}: displacement",
            f"above the overlap: a contact is stretched by {float(stretch.max()):.3g}, its initial overlap being 1 in the library's units",
        )


def scaled_contacts(contacts: Contacts | None, length: float, force: float) -> Contacts | None:
    """Overlaps and forces in other units."""
    if contacts is None:
        return None
    overlap = None if contacts.overlap is None else contacts.overlap / length
    normal = None if contacts.normal_force is None else contacts.normal_force / force
    return Contacts(contacts.pairs, overlap, normal)
