"""The line that particles form: its axis, and their order along it."""

from __future__ import annotations

import torch
from torch import Tensor

from torchchain import checks
from torchchain.frames.record import AXES, Frame


def line_axis(frame: Frame, axis: str | None) -> str | None:
    """The axis of the chain: the one given, or the one on which the particles form a line; None if they form none.

    They form one where none is farther from the first, across the axis, than half their mean distance along it.
    """
    if axis is not None:
        checks.choice("axis", axis, (*AXES, "all"))
        if axis != "all" and axis not in frame.axes:
            raise checks.fail(frame.at(axis), "be in the file for this axis", f"only {', '.join(frame.axes)}")
        return None if axis == "all" else axis
    if len(frame.axes) == 1:
        return frame.axes[0]
    offset = frame.positions - frame.positions[:1]
    for i, a in enumerate(frame.axes):
        length = frame.period(a)
        if length > 0:
            offset[:, i] -= length * (offset[:, i] / length).round()
    for i, a in enumerate(frame.axes):
        along = frame.positions[:, i]
        spacing = float(along.max() - along.min()) / max(1, len(along) - 1)
        others = [j for j in range(len(frame.axes)) if j != i]
        if spacing > 0 and float(offset[:, others].abs().max()) < spacing / 2:
            return a
    return None


def line_order(frame: Frame, axis: str) -> Tensor:
    """Places of the particles in ascending order along an axis, (particle,).

    On a periodic axis the order begins at the box's lower bound, unless the ids show where: if they ascend around
    the ring, it begins with the lowest.
    """
    column = frame.axes.index(axis)
    along = frame.positions[:, column]
    if frame.box is not None and frame.box.period(axis) > 0 and not frame.unwrapped[column]:
        low = frame.box.lower[AXES.index(axis)]
        along = low + (along - low).remainder(frame.box.period(axis))
    sorted_along, order = along.sort(stable=True)
    same = (sorted_along.diff() == 0).nonzero()
    if len(same):
        a, b = order[int(same[0])], order[int(same[0]) + 1]
        raise checks.fail(
            frame.at(axis),
            "differ from particle to particle along the chain",
            f"{along[a]:g} for ids {int(frame.ids[a])} and {int(frame.ids[b])}",
        )
    begin = int(order.argmin())
    rolled = order.roll(-begin)
    return rolled if bool((rolled.diff() > 0).all()) else order


def check_contact_order(frame: Frame, order: Tensor, axis: str) -> None:
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
        raise checks.fail(frame.at("contacts"), f"join neighbors along {axis} for a chain", f"one of ids {a} and {b}")
