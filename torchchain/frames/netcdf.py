"""The library's own file of frames: one netCDF, read many times faster than text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np

from torchchain import checks
from torchchain.frames.lammps import where
from torchchain.frames.record import AXES, Box, Frame
from torchchain.frames.registry import Entry, Format, Raw, Scan

LAYOUT = "torchchain frames 1"
PARTICLE = {"mass": "mass", "radius": "radius"}
WORDS = {
    "id": "id of each particle, ascending", "position": "position", "velocity": "velocity", "mass": "mass of each particle",
    "radius": "radius of each particle", "time": "time", "step": "time step number", "box_lower": "lower bounds of the box",
    "box_upper": "upper bounds of the box", "periodic": "1 where the box is periodic", "unwrapped": "1 where positions are unwrapped",
    "contact_frame": "frame of each contact, counted from 0", "contact_pair": "places of both particles, counted from 0; -1 for a wall",
    "contact_overlap": "sum of radii less distance", "contact_normal_force": "repulsion",
}  # fmt: skip


def write(out: Path, frames: Iterable[Frame], source: str, units: str | None) -> None:
    """Frames into a new file at ``out``, one after the other."""
    with h5netcdf.File(out, "w") as file:
        file.attrs["layout"] = LAYOUT
        file.attrs["source"] = source
        if units:
            file.attrs["units"] = units
        first: Frame | None = None
        for k, frame in enumerate(frames):
            if first is None:
                first = frame
                _create(file, frame)
            _append(file, k, frame, first)


def _create(file: Any, frame: Frame) -> None:
    n, d = frame.positions.shape
    file.dimensions = {"time": None, "particle": n, "axis": d, "corner": 3, "contact": None, "side": 2}

    def make(name: str, dimensions: tuple[str, ...], kind: str) -> None:
        chunks = None
        if dimensions[0] in ("time", "contact"):
            sizes = {
                "time": 1 if len(dimensions) > 1 else 1024,
                "particle": max(n, 1),
                "axis": max(d, 1),
                "corner": 3,
                "contact": 4096,
                "side": 2,
            }
            chunks = tuple(sizes[name] for name in dimensions)
        file.create_variable(name, dimensions, kind, chunks=chunks).attrs["long_name"] = WORDS[name]

    make("id", ("particle",), "i8")
    file.variables["id"][...] = frame.ids.numpy()
    make("position", ("time", "particle", "axis"), "f8")
    file.variables["position"].attrs["axes"] = " ".join(frame.axes)
    make("unwrapped", ("axis",), "i1")
    file.variables["unwrapped"][...] = np.array(frame.unwrapped, dtype=np.int8)
    if frame.velocities is not None:
        make("velocity", ("time", "particle", "axis"), "f8")
    for name, values in (("mass", frame.masses), ("radius", frame.radii)):
        if values is not None:
            make(name, ("particle",), "f8")
            file.variables[name][...] = values.numpy()
    if frame.time is not None:
        make("time", ("time",), "f8")
    if frame.step is not None:
        make("step", ("time",), "i8")
    if frame.box is not None:
        make("box_lower", ("time", "corner"), "f8")
        make("box_upper", ("time", "corner"), "f8")
        make("periodic", ("corner",), "i1")
        file.variables["periodic"][...] = np.array(frame.box.periodic, dtype=np.int8)
    if frame.contacts is not None:
        make("contact_frame", ("contact",), "i8")
        make("contact_pair", ("contact", "side"), "i8")
        for name, values in (
            ("contact_overlap", frame.contacts.overlap),
            ("contact_normal_force", frame.contacts.normal_force),
        ):
            if values is not None:
                make(name, ("contact",), "f8")


def _append(file: Any, k: int, frame: Frame, first: Frame) -> None:
    held = file.variables
    file.resize_dimension("time", k + 1)
    held["position"][k] = frame.positions.numpy()
    if frame.unwrapped != first.unwrapped:
        raise checks.fail(f"frame {frame.number}: positions", "stay wrapped or unwrapped", f"{frame.unwrapped}")
    if frame.velocities is not None:
        held["velocity"][k] = frame.velocities.numpy()
    if frame.time is not None:
        held["time"][k] = frame.time
    if frame.step is not None:
        held["step"][k] = frame.step
    if frame.box is not None:
        held["box_lower"][k] = frame.box.lower
        held["box_upper"][k] = frame.box.upper
    if frame.contacts is not None:
        pairs = frame.contacts.pairs.numpy()
        begin = file.dimensions["contact"].size
        file.resize_dimension("contact", begin + len(pairs))
        held["contact_frame"][begin:] = np.full(len(pairs), k)
        held["contact_pair"][begin:] = pairs
        for name, values in (
            ("contact_overlap", frame.contacts.overlap),
            ("contact_normal_force", frame.contacts.normal_force),
        ):
            if values is not None:
                held[name][begin:] = values.numpy()


def _open(path: Path) -> Any:
    try:
        file = h5netcdf.File(path, "r")
    except Exception as error:  # h5py lets through many kinds for a damaged file
        raise checks.fail(path.name, "be a whole netCDF file", f"{type(error).__name__}: {error}") from None
    if file.attrs.get("layout") != LAYOUT or not {"id", "position", "unwrapped"} <= set(file.variables):
        layout = file.attrs.get("layout")
        file.close()
        raise checks.fail(path.name, f"be a netCDF file of '{LAYOUT}' (torchchain convert writes one)", repr(layout))
    return file


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    with _open(path) as file:
        held = file.variables
        n_frames, n = held["position"].shape[:2]
        for name, shape in (("time", (n_frames,)), ("step", (n_frames,)), ("velocity", held["position"].shape), ("id", (n,)), ("mass", (n,)), ("radius", (n,)), ("box_lower", (n_frames, 3)), ("box_upper", (n_frames, 3))):  # fmt: skip
            if name in held and tuple(held[name].shape) != tuple(shape):
                raise checks.fail(f"{path.name}: {name}", f"have shape {tuple(shape)}", f"{tuple(held[name].shape)}")
        times = held["time"][...] if "time" in held else [None] * n_frames
        steps = held["step"][...] if "step" in held else [None] * n_frames
        entries = [
            Entry(k + 1, k, n, None if step is None else int(step), None if time is None else float(time))
            for k, (step, time) in enumerate(zip(steps, times, strict=True))
        ]
        return Scan(entries, None, file.attrs.get("units"))


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    with _open(path) as file:
        held = file.variables
        axes = str(held["position"].attrs.get("axes", "")).split()
        if len(axes) != held["position"].shape[-1] or not set(axes) <= set(AXES):
            raise checks.fail(f"{path.name}: position", "name its axes", checks.shown(" ".join(axes), 40))
        fixed = {"id": held["id"][...]} | {name: held[name][...] for name in ("mass", "radius") if name in held}
        going = frozenset(axis for axis, flag in zip(axes, held["unwrapped"][...], strict=True) if flag)
        for entry in entries:
            position = held["position"][entry.offset]
            found = fixed | {axis: position[:, i] for i, axis in enumerate(axes)}
            if "velocity" in held:
                velocity = held["velocity"][entry.offset]
                found |= {f"v{axis}": velocity[:, i] for i, axis in enumerate(axes)}
            for name, values in found.items():
                if not np.isfinite(values).all() and not (name == "mass" and not np.isnan(values).any()):
                    raise checks.fail(
                        f"{where(path.name, entry.number)}: {name}",
                        "be a finite number",
                        f"one in row {int((~np.isfinite(values)).argmax()) + 1} that is not",
                    )
            box = None
            if "box_lower" in held:
                (xl, yl, zl), (xh, yh, zh) = (
                    held["box_lower"][entry.offset].tolist(),
                    held["box_upper"][entry.offset].tolist(),
                )
                px, py, pz = (bool(flag) for flag in held["periodic"][...])
                box = Box((xl, yl, zl), (xh, yh, zh), (px, py, pz))
            yield Raw(found, box, going)


def read_contacts(path: Path, entries: Iterable[Entry]) -> Iterator[dict[str, np.ndarray] | None]:
    """Places and what else there is of the contacts of each frame, None if the file has no contacts."""
    with _open(path) as file:
        held = file.variables
        if "contact_frame" not in held:
            for _ in entries:
                yield None
            return
        of_frame = held["contact_frame"][...]
        for entry in entries:
            low, high = np.searchsorted(of_frame, [entry.offset, entry.offset + 1])
            found = {"pairs": held["contact_pair"][low:high]}
            for name in ("overlap", "normal_force"):
                if f"contact_{name}" in held:
                    found[name] = held[f"contact_{name}"][low:high]
            yield found


FORMAT = Format(
    name="netcdf",
    holds="particles",
    summary="netCDF written by torchchain convert, with contacts",
    endings=(".nc",),
    recognizes=lambda head: head.startswith(b"\x89HDF") or head.startswith(b"CDF"),
    scan=_scan,
    read=_read,
)
