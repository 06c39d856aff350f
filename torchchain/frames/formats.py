"""The formats that are known, one record each."""

from __future__ import annotations

from torchchain.frames import lammps, lammps_local, liggghts_local, mercury, mercury_fstat, netcdf, xyz
from torchchain.frames.registry import Format

FORMATS: dict[str, Format] = {
    entry.name: entry
    for entry in (
        lammps.FORMAT, mercury.FORMAT, xyz.FORMAT, netcdf.FORMAT, liggghts_local.FORMAT, lammps_local.FORMAT, mercury_fstat.FORMAT,
    )
}  # fmt: skip
