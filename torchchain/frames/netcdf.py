"""The library's own file of frames: one netCDF, read many times faster than text."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.passes import where
from torchchain.frames.record import AXES, Box, Frame
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import GZIP_RATIO

LAYOUT = "torchchain frames 1"
BLOCK = 1 << 21  # bytes of positions that are written and read together
CONTACT = ("overlap", "normal_force")
FLOATS = ("position", "velocity", "time", "mass", "radius", "box_lower", "box_upper")
WORDS = {
    "id": "id of each particle, ascending", "position": "position", "velocity": "velocity", "mass": "mass of each particle",
    "radius": "radius of each particle", "time": "time", "step": "time step number", "box_lower": "lower bounds of the box",
    "box_upper": "upper bounds of the box", "periodic": "1 where the box is periodic", "unwrapped": "1 where positions are unwrapped",
    "contact_frame": "frame of each contact, counted from 0", "contact_pair": "places of both particles, counted from 0; -1 for a wall",
    "contact_overlap": "sum of radii less distance", "contact_normal_force": "repulsion",
}  # fmt: skip


def write(out: Path, frames: Iterable[Frame], source: str, units: str | None) -> None:
    """Frames into a new file at ``out``, a block of them at a time."""
    import h5netcdf

    with h5netcdf.File(out, "w") as file:
        file.attrs["layout"] = LAYOUT
        file.attrs["source"] = source
        if units:
            file.attrs["units"] = units
        first: Frame | None = None
        held: list[Frame] = []
        done = 0
        for frame in frames:
            if first is None:
                first = frame
                _create(file, frame)
            if frame.unwrapped != first.unwrapped or (frame.contacts is None) != (first.contacts is None):
                raise checks.fail(f"frame {frame.number}", "hold what the first frame does", "other fields")
            held.append(frame)
            if len(held) == _block(first):
                _append(file, done, held)
                done, held = done + len(held), []
        if held:
            _append(file, done, held)


def _block(frame: Frame) -> int:
    """Frames that are written and read together."""
    return max(1, BLOCK // (8 * frame.positions.numel()))


def _create(file: Any, frame: Frame) -> None:
    n, d = frame.positions.shape
    file.dimensions = {"time": None, "particle": n, "axis": d, "corner": 3, "contact": None, "side": 2}
    sizes = {"time": _block(frame), "particle": n, "axis": d, "corner": 3, "contact": 4096, "side": 2}

    def make(name: str, dimensions: tuple[str, ...], kind: str, values: Any = None) -> None:
        growing = dimensions[0] in ("time", "contact")
        chunks = tuple(sizes[dimension] for dimension in dimensions) if growing else None
        file.create_variable(name, dimensions, kind, chunks=chunks).attrs["long_name"] = WORDS[name]
        if values is not None:
            file.variables[name][...] = np.asarray(values, dtype=kind)

    make("id", ("particle",), "i8", frame.ids)
    make("position", ("time", "particle", "axis"), "f8")
    file.variables["position"].attrs["axes"] = " ".join(frame.axes)
    make("unwrapped", ("axis",), "i1", frame.unwrapped)
    if frame.velocities is not None:
        make("velocity", ("time", "particle", "axis"), "f8")
    for name, values in (("mass", frame.masses), ("radius", frame.radii)):
        if values is not None:
            make(name, ("particle",), "f8", values)
    if frame.time is not None:
        make("time", ("time",), "f8")
    if frame.step is not None:
        make("step", ("time",), "i8")
    if frame.box is not None:
        make("box_lower", ("time", "corner"), "f8")
        make("box_upper", ("time", "corner"), "f8")
        make("periodic", ("corner",), "i1", frame.box.periodic)
    if frame.contacts is not None:
        make("contact_frame", ("contact",), "i8")
        make("contact_pair", ("contact", "side"), "i8")
        for name in CONTACT:
            if getattr(frame.contacts, name) is not None:
                make(f"contact_{name}", ("contact",), "f8")


def _append(file: Any, done: int, frames: list[Frame]) -> None:
    held, end = file.variables, done + len(frames)
    file.resize_dimension("time", end)
    columns: dict[str, list[Any]] = {
        "position": [frame.positions.numpy() for frame in frames],
        "velocity": [frame.velocities.numpy() for frame in frames if frame.velocities is not None],
        "time": [frame.time for frame in frames],
        "step": [frame.step for frame in frames],
        "box_lower": [frame.box.lower for frame in frames if frame.box is not None],
        "box_upper": [frame.box.upper for frame in frames if frame.box is not None],
    }
    for name, values in columns.items():
        if name in held:
            if len(values) < len(frames):
                raise checks.fail(name, "be in all frames or in none", f"{len(values)} of {len(frames)} frames")
            held[name][done:end] = np.array(values)
    listed = [(k, frame.contacts) for k, frame in enumerate(frames) if frame.contacts is not None]
    if not listed:
        return
    begin = file.dimensions["contact"].size
    pairs = np.concatenate([contacts.pairs.numpy() for _, contacts in listed])
    file.resize_dimension("contact", begin + len(pairs))
    held["contact_frame"][begin:] = np.concatenate([np.full(len(contacts.pairs), done + k) for k, contacts in listed])
    held["contact_pair"][begin:] = pairs
    for name in CONTACT:
        if f"contact_{name}" in held:
            held[f"contact_{name}"][begin:] = np.concatenate(
                [getattr(contacts, name).numpy() for _, contacts in listed]
            )


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """The file, by h5py, whose access to a part of a variable is a hundred times quicker than h5netcdf's."""
    import h5py

    try:
        file = h5py.File(path, "r")
    except Exception as error:  # h5py lets through many kinds for a damaged file
        raise checks.fail(path.name, "be a whole netCDF file", f"{type(error).__name__}: {error}") from None
    with file:
        try:
            layout = file.attrs.get("layout")
            if layout != LAYOUT or not {"id", "position", "unwrapped"} <= set(file):
                words = "none" if layout is None else checks.shown(layout, 40)
                raise checks.fail(f"{path.name}: layout", f"be '{LAYOUT}' (torchchain convert writes it)", words)
            yield file
        except (checks.FieldError, checks.FieldTypeError):
            raise
        except Exception as error:
            raise checks.fail(path.name, "be a whole netCDF file", f"{type(error).__name__}: {error}") from None


def _holds(file: Any, name: str) -> bool:
    """Whether the file has this variable; a dimension alone has a place in it too."""
    return name in file and not bytes(file[name].attrs.get("NAME", b"")).startswith(
        b"This is a netCDF dimension but not"
    )


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    with _open(path) as file:
        shape = file["position"].shape
        if len(shape) != 3:
            raise checks.fail(f"{path.name}: position", "have axes time, particle and axis", f"shape {shape}")
        room = GZIP_RATIO * path.stat().st_size
        for name in file:
            if _holds(file, name) and file[name].nbytes > room:
                raise checks.fail(f"{path.name}: {name}", "fit into the file", f"shape {file[name].shape}")
        n_frames, n, d = shape
        shapes = {
            "position": shape, "velocity": shape, "time": (n_frames,), "step": (n_frames,), "id": (n,), "mass": (n,), "radius": (n,),
            "unwrapped": (d,), "box_lower": (n_frames, 3), "box_upper": (n_frames, 3), "periodic": (3,),
        }  # fmt: skip
        for name, expected in shapes.items():
            if not _holds(file, name):
                continue
            if file[name].shape != expected or file[name].dtype.kind not in ("f" if name in FLOATS else "iu"):
                raise checks.fail(
                    f"{path.name}: {name}",
                    f"be numbers of shape {expected}",
                    f"{file[name].dtype} of shape {file[name].shape}",
                )
        if ("box_lower" in file) != ("box_upper" in file) or ("box_lower" in file) != ("periodic" in file):
            raise checks.fail(f"{path.name}: box", "have lower and upper bounds and flags", "some of them")
        times = file["time"][...].tolist() if _holds(file, "time") else [None] * n_frames
        steps = file["step"][...].tolist() if _holds(file, "step") else [None] * n_frames
        for k, time in enumerate(times):
            if time is not None and not np.isfinite(time):
                raise checks.fail(f"{where(path.name, k + 1)}: time", "be a finite number", time)
        entries = [Entry(k + 1, k, n, step, time) for k, (step, time) in enumerate(zip(steps, times, strict=True))]
        units = file.attrs.get("units")
        return Scan(entries, None, units if isinstance(units, str) else None)


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    with _open(path) as file:
        axes = str(file["position"].attrs.get("axes", "")).split()
        n, d = file["position"].shape[1:]
        if len(axes) != d or len(set(axes)) != d or not set(axes) <= set(AXES):
            raise checks.fail(f"{path.name}: position", "name its axes", checks.shown(" ".join(axes), 40))
        fixed = {name: file[name][...] for name in ("id", "mass", "radius") if name in file}
        going = frozenset(axis for axis, flag in zip(axes, file["unwrapped"][...], strict=True) if flag)
        block = max(1, BLOCK // max(1, 8 * n * d))
        flags = file["periodic"][...].tolist() if "periodic" in file else None
        held: dict[str, np.ndarray] = {}
        of_frame = file["contact_frame"][...] if "contact_frame" in file else None
        begin = -block
        for entry in entries:
            if not begin <= entry.offset < begin + block:
                begin = entry.offset
                held = {
                    name: file[name][begin : begin + block]
                    for name in ("position", "velocity", "box_lower", "box_upper")
                    if name in file
                }
            at = entry.offset - begin
            found = dict(fixed)
            for name, letter in (("position", ""), ("velocity", "v")):
                if name in held:
                    found |= {f"{letter}{axis}": held[name][at, :, i] for i, axis in enumerate(axes)}
            for name, values in found.items():
                bad = ~np.isfinite(values) if name != "mass" else np.isnan(values)  # a fixed particle's is infinite
                if bad.any():
                    raise checks.fail(
                        f"{where(path.name, entry.number)}: {name}",
                        "be a finite number",
                        f"{values[bad][0]} in row {int(bad.argmax()) + 1}",
                    )
            box = None
            if flags is not None:
                lower, upper = (tuple(held[name][at].tolist()) for name in ("box_lower", "box_upper"))
                box = Box(lower, upper, tuple(map(bool, flags)))
            contacts = None
            if of_frame is not None:
                low, high = np.searchsorted(of_frame, [entry.offset, entry.offset + 1])
                contacts = {"pairs": file["contact_pair"][low:high]} | {
                    name: file[f"contact_{name}"][low:high] for name in CONTACT if f"contact_{name}" in file
                }
            yield Raw(found, box, going, contacts)


FORMAT = Format(
    name="netcdf",
    holds="particles",
    summary="netCDF written by torchchain convert, with contacts",
    endings=(".nc",),
    recognizes=lambda head: head.startswith((b"\x89HDF", b"CDF")),
    scan=_scan,
    read=_read,
)
