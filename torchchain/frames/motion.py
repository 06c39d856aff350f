"""From frames to a trajectory: displacements from a reference, across periodic boundaries."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.states import Trajectory
from torchchain.frames.building import check_properties
from torchchain.frames.doubts import check_across, check_bounds, check_digits, warn
from torchchain.frames.order import check_contact_order, line_axis, line_order
from torchchain.frames.record import AXES, TIMED, Frame
from torchchain.memory import gigabytes, memory
from torchchain.network import NetworkTrajectory


def displacements(
    frames: Iterable[Frame],
    n_frames: int,
    first: Frame,
    reference: Frame,
    axis: str | None,
    length: float,
) -> Trajectory:
    """Displacements from a reference, and velocities; see :meth:`Frames.trajectory`."""
    _check_alike(first, reference)
    line = line_axis(first, axis)
    columns = list(range(len(first.axes))) if line is None else [first.axes.index(line)]
    order = torch.arange(len(first.ids)) if line is None else line_order(first, line)
    if line is not None:
        check_contact_order(first, order, line)
    size = 16 * n_frames * len(order) * len(columns)
    limit = memory(torch.device("cpu"))
    if size > limit:
        raise checks.fail(
            first.at("frames"),
            f"fit into the {gigabytes(limit)} of memory of this machine (take fewer, as in frames[::10])",
            f"{gigabytes(size)} of displacements and velocities",
        )
    shape = (n_frames, len(order), len(columns))
    moved, velocity = torch.empty(shape, dtype=torch.float64), torch.empty(shape, dtype=torch.float64)
    times = torch.empty(n_frames, dtype=torch.float64)
    rest = reference.positions[order][:, columns]
    wraps = [
        reference.period(first.axes[c]) if not (first.unwrapped[c] and reference.unwrapped[c]) else 0.0 for c in columns
    ]
    before = torch.zeros_like(rest)
    last, sources, crossed = first, [], set[int]()
    for k, frame in enumerate(frames):
        if frame.velocities is None:
            raise checks.fail(
                frame.at("velocities"),
                f"be in the file (columns {' '.join('v' + a for a in frame.axes)})",
                "none",
            )
        if frame.time is None:
            raise checks.fail(frame.at("TIME"), TIMED, "none")
        u = frame.positions[order][:, columns] - rest
        for i, (column, side) in enumerate(zip(columns, wraps, strict=True)):
            if side:
                _check_box(frame, reference, first.axes[column])
                turns = ((u[:, i] - before[:, i]) / side).round()
                u[:, i] -= side * turns
                if bool(turns.any()):
                    crossed.add(column)
            elif frame.box is not None and not frame.unwrapped[column]:
                _check_jump(frame, u[:, i], first.axes[column])
        times[k], moved[k], velocity[k], before = frame.time, u, frame.velocities[order][:, columns], u
        last = frame
        sources.append(frame.source)
    check_digits(last, [first.axes[c] for c in columns], moved, length)
    for column in sorted(crossed):
        check_bounds(last, first.axes[column], moved, length)
    if line is not None:
        _check_line(sources, moved[..., 0], first, reference, order, line)
        check_across(last, line)
        return Trajectory(times - times[0], moved[..., 0], velocity[..., 0])
    return NetworkTrajectory(times - times[0], moved, velocity)


def _check_alike(first: Frame, reference: Frame) -> None:
    """An error unless the reference has the same particles and axes."""
    if reference.axes != first.axes:
        words = f"be along {', '.join(first.axes)} as in {first.source}"
        raise checks.fail(reference.at("positions"), words, ", ".join(reference.axes))
    if not torch.equal(reference.ids, first.ids):
        counts = f"{len(reference.ids)} particles against {len(first.ids)}"
        others = "others" if len(reference.ids) == len(first.ids) else counts
        raise checks.fail(reference.at("ids"), f"be those of {first.source}", others)
    check_properties(reference, first, f"be those of {first.source}")


def _check_box(frame: Frame, reference: Frame, axis: str) -> None:
    now, then = frame.period(axis), reference.period(axis)
    if abs(now - then) > 1e-6 * then:
        raise checks.fail(
            frame.at("box"),
            f"keep its length {then:g} along {axis} for positions that wrap (or dump {axis}u)",
            f"{now:g}",
        )


def _check_jump(frame: Frame, u: Tensor, axis: str) -> None:
    """An error for a particle that seems to have crossed a box that is not marked as periodic."""
    assert frame.box is not None
    length = float(frame.box.lengths[AXES.index(axis)])
    if length > 0 and bool((u.abs() > 0.9 * length).any()):
        bad = int(u.abs().argmax())
        raise checks.fail(
            frame.at(axis),
            'stay on one side of a box that is not marked periodic (periodic="x" marks it)',
            f"a step of {float(u[bad]):g} for id {int(frame.ids[bad])}",
        )


def _check_line(sources: list[str], moved: Tensor, first: Frame, reference: Frame, order: Tensor, axis: str) -> None:
    """An error for neighbors that passed each other, a warning for contacts that opened.

    Args:
        sources: of the frames.
        moved: displacements along the axis, (time, particle).
        first, reference: the first frame and the state at rest.
        order: of the chain.
        axis: of the chain.
    """
    rest, ids = reference.positions[order, first.axes.index(axis)], first.ids[order].tolist()
    period = reference.period(axis)
    n = len(order)
    gap, stretch = rest.diff(), moved.diff(dim=-1)
    if period:
        gap = (rest.roll(-1) - rest).remainder(period)
        stretch = moved.roll(-1, -1) - moved
    wrong = (
        gap <= 0 if not period else torch.full_like(gap, abs(float(gap.sum()) - period) > period / 2, dtype=torch.bool)
    )
    if bool(wrong.any()):
        raise checks.fail(first.at(axis), "have the order of the reference in the first frame", "another order")
    crossed = gap + stretch <= 0
    if bool(crossed.any()):
        k, c = (int(i) for i in crossed.nonzero()[0])
        raise checks.fail(
            f"{sources[k]}: {axis}",
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
            reference.at("radius"),
            f"ids {ids[c]} and {ids[c + 1]} do not touch in the reference, by {-float(overlap[c]):.3g}",
        )
        return
    opened = (stretch >= overlap) & (overlap > 0)
    if bool(opened.any()):
        k, c = (int(i) for i in opened.nonzero()[0])
        warn(
            f"{sources[k]}: {axis}",
            f"displacements above the overlap: the contact of ids {ids[c]} and {ids[(c + 1) % n]} opened (stretched by {float(stretch[k, c]):.3g}, overlap {float(overlap[c]):.3g})",
        )
