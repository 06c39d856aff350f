"""The formats that are known, one record each."""

from __future__ import annotations

from torchchain.frames import contact_lists, lammps, mercury, mercury_fstat, netcdf, xyz
from torchchain.frames.registry import Format

FORMATS: dict[str, Format] = {
    entry.name: entry
    for entry in (
        lammps.FORMAT, mercury.FORMAT, xyz.FORMAT, netcdf.FORMAT, contact_lists.LIGGGHTS, contact_lists.LAMMPS, mercury_fstat.FORMAT,
    )
}  # fmt: skip
