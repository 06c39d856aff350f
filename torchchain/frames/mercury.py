"""MercuryDPM: ``.data`` files of particles, with masses from the ``.restart`` beside them.

Layouts as its DPMBase (outputXBallsData, readNextDataFile) and BaseParticle (write) have them, of version 1.0 and later.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from torchchain import checks
from torchchain.frames.passes import Passed, frames_at, scanned, where
from torchchain.frames.record import Box
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.text import CutShort, Text, number_of, parse

# A header of N, time and the corners of the domain: 2 + 4 numbers in two dimensions, 2 + 6 in three. A row is position,
# velocity, radius, angle, angular velocity and one number of the user's (the species unless changed).
FLAT = ("x", "y", "vx", "vy", "radius", "angle", "spin", "info")
SOLID = (
    "x",
    "y",
    "z",
    "vx",
    "vy",
    "vz",
    "radius",
    "angle_x",
    "angle_y",
    "angle_z",
    "spin_x",
    "spin_y",
    "spin_z",
    "info",
)
WANTED = {"x", "y", "z", "vx", "vy", "vz", "radius"}


def _header(text: Text, number: int) -> tuple[int, float, list[float]] | None:
    line = text.line()
    while line == "":
        line = text.line()
    if line is None:
        return None
    here, words = where(text.name, number), line.split()
    numbers = [value for value in map(number_of, words) if value is not None]
    if len(numbers) not in (6, 8) or len(words) != len(numbers):
        raise checks.fail(
            f"{here}: header",
            "be N, time and the corners of the domain (6 or 8 finite numbers)",
            checks.shown(line, 50),
        )
    count, time, *corners = numbers
    if count != int(count) or not 0 <= count < 2**53:
        raise checks.fail(f"{here}: N", "be a whole number, not negative", words[0])
    half = len(corners) // 2
    for low, high in zip(corners[:half], corners[half:], strict=True):
        if low > high:
            raise checks.fail(f"{here}: header", "give the corners of the domain in order", f"{low:g} {high:g}")
    if not text.room_for(int(count), 8):
        raise checks.fail(f"{here}: N", "fit into the file", words[0])
    return int(count), time, corners


def _scan(path: Path, options: dict[str, Any]) -> Scan:
    def passed(text: Text, number: int) -> Passed | None:
        header = _header(text, number)
        if header is None:
            return None
        for _ in text.blocks(header[0]):
            pass
        return header[0], None, header[1]

    return scanned(path, passed)


def _read(path: Path, entries: Iterable[Entry], options: dict[str, Any]) -> Iterator[Raw]:
    columns: tuple[str, ...] | None = None
    for text, here, _, (count, _, corners) in frames_at(path, entries, _header):
        if columns is None and count:
            columns = _columns(here, text, len(corners) // 2)
        rows = parse(here, text.blocks(count), columns or SOLID, set(), WANTED)
        rows["id"] = np.arange(count)
        yield Raw(rows, _box(corners))


def _box(corners: list[float]) -> Box:
    """The domain. The file does not say which boundaries are periodic, and MercuryDPM wraps at those that are."""
    half = len(corners) // 2
    low, high = ((*side, 0.0)[:3] for side in (corners[:half], corners[half:]))
    return Box(low, high, (False,) * 3)


def _columns(here: str, text: Text, dimensions: int) -> tuple[str, ...]:
    """The names of the columns, from how many the first row has."""
    at, first = text.position, (text.line() or "").split()
    text.seek(at)
    if dimensions == 2 and len(first) == len(FLAT):
        return FLAT
    # Two numbers more where a parallel run marks its ghosts, one where a second species is written.
    if dimensions == 3 and len(SOLID) <= len(first) <= len(SOLID) + 2:
        return (*SOLID, *("more", "most")[: len(first) - len(SOLID)])
    wanted = "8 columns in two dimensions" if dimensions == 2 else "14 columns in three dimensions"
    raise checks.fail(f"{here}: row 1", f"hold {wanted}", f"{len(first)}")


def sibling(path: Path) -> Path | None:
    """The .restart of the same run: name.restart beside name.data, also for name.data.7."""
    stem = path.name.removesuffix(".gz")
    stem = stem[: stem.rfind(".data")] if ".data" in stem else stem
    found = path.parent / f"{stem}.restart"
    return found if found.is_file() else None


def read_restart(path: Path) -> dict[str, np.ndarray]:
    """Id, mass and radius of the particles in a ``.restart`` file, in its order; the mass of a fixed one is infinite."""
    found: dict[str, list[float]] = {"id": [], "mass": [], "radius": []}
    with Text(path) as text:
        announced = None
        try:
            line = text.line()
            if line is None or line.split()[:1] not in (["MercuryDPM"], ["restart_version"]):
                raise checks.fail(path.name, "begin with 'MercuryDPM' (a .restart file)", checks.shown(line, 40))
            while announced is None:
                line = text.line()
                if line is None:
                    raise checks.fail(path.name, "have a line 'Particles N'", "none")
                words = line.split()
                if words[:1] == ["Particles"] and len(words) == 2 and words[1].isdigit():
                    announced = int(words[1])
            while len(found["id"]) < announced:
                line = text.line()
                if line is None:
                    raise CutShort
                _particle(f"{path.name}: particle {len(found['id']) + 1}", line.split(), found)
        except CutShort:
            raise checks.fail(
                f"{path.name}: Particles", f"be the {announced} announced", f"{len(found['id'])} whole ones"
            ) from None
    return {name: np.array(values, dtype=np.int64 if name == "id" else np.float64) for name, values in found.items()}


def _particle(here: str, words: list[str], found: dict[str, list[float]]) -> None:
    for name, key in (("id", "id"), ("radius", "radius"), ("mass", "invMass")):
        if key not in words[:-1]:
            raise checks.fail(here, f"state its {key}", checks.shown(" ".join(words), 50))
        word = words[words.index(key) + 1]
        value = number_of(word)
        if value is None or not 0 <= value < 2**63 or (name == "id" and value % 1):
            raise checks.fail(f"{here}: {key}", "be a number, not negative", checks.shown(word, 40))
        found[name].append(value if name != "mass" else (1 / value if value else np.inf))


def _recognizes(head: bytes) -> bool:
    words = head.partition(b"\n")[0].decode("latin-1").split()
    return len(words) in (6, 8) and all(number_of(word) is not None for word in words)


FORMAT = Format(
    name="mercury",
    holds="particles",
    summary="MercuryDPM .data of two or three dimensions; ids are the particles' places, masses those of the .restart beside it",
    endings=(".data",),
    recognizes=_recognizes,
    scan=_scan,
    read=_read,
    match="time",
    sibling=sibling,
)
