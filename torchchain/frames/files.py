"""Frames from the files of other codes, and into one file that is read many times faster."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchchain import checks
from torchchain.frames import netcdf
from torchchain.frames.opening import Source, find
from torchchain.frames.reading import Frames


def read_frames(
    path: Source | Sequence[Source],
    contacts: Source | Sequence[Source] | None = None,
    format: str | None = None,
    **options: Any,
) -> Frames:
    r"""Frames of a trajectory that another code wrote.

    One pass looks at the headers and counts rows; positions are read when a frame is asked for.

    Args:
        path: a file, plain or gzip; a pattern such as "post/dump*.liggghts"; or a list of files, whose frames follow each other.
        contacts: the same for contact lists (LAMMPS and LIGGGHTS dump local, MercuryDPM .fstat), matched by time step or time.
        format: a name in ``torchchain.frames.FORMATS``; by default what the file begins with.
        options: as named below.

    Keyword Args:
        time_step: time between two step numbers, for dumps without ITEM: TIME.
        masses: where the file has none: a number, one for each id in ascending order, a dict from type to mass, or a
            MercuryDPM .restart file.
        density: masses from the radii: of spheres, or of disks where the file has two dimensions.
        contact_columns: which columns of a contact list are which; see ``FORMATS[...].options``.
        periodic: axes such as "x" or "xy" on which the box is periodic, where the file does not say.

    Returns:
        Frames, at least one.

    Raises:
        FieldError: in one line with file, frame and field, for a file that cannot be read or does not hold together.

    Warns:
        FramesWarning: for a last frame that is cut short, which is left out.

    >>> from pathlib import Path
    >>> from tempfile import mkdtemp
    >>> frame = "ITEM: TIMESTEP\n{0}\nITEM: NUMBER OF ATOMS\n2\nITEM: ATOMS id mass xu vx\n1 0.9 0 {0}\n2 1.1 1 0\n"
    >>> path = Path(mkdtemp(), "run.dump")
    >>> written = path.write_text(frame.format(0) + frame.format(1))
    >>> frames = read_frames(path, time_step=0.01)
    >>> frames
    Frames('run.dump', lammps: 2 frames of 2 particles)
    >>> frames.chain("fixed").masses.tolist(), frames.trajectory().velocity.tolist()
    ([0.9, 1.1], [[0.0, 0.0], [1.0, 0.0]])
    >>> read_frames(convert(path, path.with_name("run.nc"), time_step=0.01))
    Frames('run.nc', netcdf: 2 frames of 2 particles)
    """
    return Frames(*find(path, contacts, format, options))


def convert(
    path: Source | Sequence[Source],
    out: Source,
    contacts: Source | Sequence[Source] | None = None,
    format: str | None = None,
    **options: Any,
) -> Path:
    """Write frames into one netCDF file that :func:`read_frames` reads many times faster than text.

    Args:
        path, contacts, format, options: as for :func:`read_frames`.
        out: the file to be written; it appears when it is whole.

    Returns:
        The path of the new file.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> path = Path(mkdtemp(), "run.dump")
        >>> _ = path.write_text("ITEM: TIMESTEP\\n0\\nITEM: NUMBER OF ATOMS\\n2\\nITEM: ATOMS id mass xu vx\\n1 1 0 0\\n2 1 1 0\\n")
        >>> tc.frames.convert(path, path.with_name("run.nc"), time_step=0.01).name
        'run.nc'
    """
    frames = read_frames(path, contacts, format, **options)
    target = Path(out)
    if target.exists() and any(target.samefile(place.file.path) for place in frames._places):
        raise checks.fail("out", "be another file than those read", str(target))
    if target.is_dir() or not target.parent.is_dir():
        raise checks.fail("out", "be a file in a folder that is there", str(target))
    try:
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=".convert-") as scratch:
            part = Path(scratch) / "frames.nc"
            netcdf.write(part, frames, frames.name, frames.file_units)
            os.replace(part, target)
    except OSError as error:
        raise checks.fail("out", "be a file that can be written", f"{target}: {error.strerror or error}") from None
    return target
