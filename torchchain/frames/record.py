"""What a file of trajectories holds: one frame, its box and its contacts."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

AXES = ("x", "y", "z")
TIMED = "be in the file (LAMMPS: dump_modify ... time yes) or follow from time_step="
"""The rule for times."""


class FramesWarning(UserWarning):
    """Something in a file that makes a result doubtful, with its file, frame and field.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> import warnings
        >>> path = Path(mkdtemp(), "cut.dump")
        >>> head = "ITEM: TIMESTEP\\n0\\nITEM: NUMBER OF ATOMS\\n2\\nITEM: ATOMS id mass xu vx\\n1 1 0 0\\n"
        >>> _ = path.write_text(head + "2 1 1 0\\n" + head)  # the second frame lacks a particle
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     frames = tc.read_frames(path, time_step=0.01)
        >>> told[0].category.__name__, len(frames)
        ('FramesWarning', 1)
    """


@dataclass(frozen=True)
class Box:
    """A box with sides along the axes, in the file's unit of length.

    Attributes:
        lower, upper: bounds along x, y, z.
        periodic: whether what leaves on one side comes in on the other, for each axis.

    Example:
        >>> box = tc.frames.Box((0.0, 0.0, 0.0), (10.0, 1.0, 1.0), (True, False, False))
        >>> box.lengths
        tensor([10.,  1.,  1.], dtype=torch.float64)
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    periodic: tuple[bool, ...]

    @property
    def lengths(self) -> Tensor:
        """Lengths of the sides, (3,)."""
        return torch.tensor(self.upper, dtype=torch.float64) - torch.tensor(self.lower, dtype=torch.float64)

    def period(self, axis: str) -> float:
        """The distance along "x", "y" or "z" after which what leaves comes in again; 0 where the box is not periodic."""
        i = AXES.index(axis)
        return self.upper[i] - self.lower[i] if self.periodic[i] else 0.0


@dataclass(frozen=True, eq=False)
class Contacts:
    """The contacts of one frame, each once.

    Attributes:
        pairs: positions in the frame's particles, counted from 0, (contact, 2), int64; -1 for a wall.
        overlap: sum of radii less distance, (contact,), or None where the file does not say.
        normal_force: repulsion, (contact,), or None.

    Example:
        >>> contacts = tc.frames.Contacts(torch.tensor([[0, 1], [1, -1]]), overlap=torch.tensor([0.1, 0.2]))
        >>> contacts.pairs[:, 1].tolist()  # the second contact is with a wall
        [1, -1]
    """

    pairs: Tensor
    overlap: Tensor | None = None
    normal_force: Tensor | None = None

    def where(self, keep: Tensor) -> Contacts:
        """Those where ``keep`` (contact,) holds."""
        overlap, force = (None if v is None else v[keep] for v in (self.overlap, self.normal_force))
        return Contacts(self.pairs[keep], overlap, force)


@dataclass(frozen=True, eq=False)
class Frame:
    """All particles at one instant, in ascending order of their ids, in the file's units.

    Attributes:
        number: of the frame in its source, counted from 1.
        step: time step number, or None.
        time: None where the file has only step numbers and no time step was given.
        ids: (particle,), int64.
        axes: the axes that the file holds, of "x", "y", "z".
        positions: (particle, axis).
        unwrapped: for each axis, whether the positions went on where a particle crossed the box.
        velocities: (particle, axis), or None.
        masses, radii: (particle,), or None.
        box: or None.
        contacts: or None.
        source: file and frame, as errors name them.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> path = Path(mkdtemp(), "run.dump")
        >>> _ = path.write_text("ITEM: TIMESTEP\\n0\\nITEM: NUMBER OF ATOMS\\n2\\nITEM: ATOMS id mass xu vx\\n1 1 0 0\\n2 1 1 0\\n")
        >>> frame = tc.read_frames(path, time_step=0.01)[0]
        >>> frame.axes, frame.ids.tolist(), frame.positions.tolist()
        (('x',), [1, 2], [[0.0], [1.0]])
    """

    number: int
    step: int | None
    time: float | None
    ids: Tensor
    axes: tuple[str, ...]
    positions: Tensor
    unwrapped: tuple[bool, ...]
    velocities: Tensor | None = None
    masses: Tensor | None = None
    radii: Tensor | None = None
    box: Box | None = None
    contacts: Contacts | None = None
    source: str = "reference"

    def at(self, field: str) -> str:
        """Where it is from and a field, as errors and warnings begin."""
        return f"{self.source}: {field}"

    def period(self, axis: str) -> float:
        """See :meth:`Box.period`; 0 without a box."""
        return self.box.period(axis) if self.box is not None else 0.0
