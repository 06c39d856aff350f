"""Files of other codes that are damaged, hostile or do not hold together: one line with file, frame and field, in bounded memory."""

from __future__ import annotations

import gzip
import importlib.util
import os
import subprocess
import sys

import h5py
import pytest

from torchchain import checks
from torchchain.frames import FORMATS, FramesWarning, convert, read_frames

N = 4
BOX = "ITEM: BOX BOUNDS pp ff ff\n0 4\n-1 1\n-1 1\n"
HAS_ASE = importlib.util.find_spec("ase") is not None


def dump(frame=0, rows=None, box=BOX, columns="id mass x vx", n=N, time=True, step=None):
    """One frame of a LAMMPS dump."""
    rows = [f"{i + 1} {1 + 0.1 * i} {i + 0.5 + 0.01 * frame} 0.0" for i in range(N)] if rows is None else rows
    begin = f"ITEM: TIME\n{0.5 * frame}\n" if time else ""
    step = 10 * frame if step is None else step
    return f"{begin}ITEM: TIMESTEP\n{step}\nITEM: NUMBER OF ATOMS\n{n}\n{box}ITEM: ATOMS {columns}\n" + "".join(
        f"{row}\n" for row in rows
    )


GOOD = dump(0) + dump(1)
DATA = "".join(
    f"3 {0.1 * k} 0 0 0 4 1 1 \n" + "".join(f"{i + 0.5} 0 0 {0.1 * k} 0 0 0.5 0 0 0 0 0 0 0\n" for i in range(3))
    for k in range(2)
)
FLAT = "".join(
    f"2 {0.1 * k} 0 0 4 1 \n" + "".join(f"{i + 0.5} 0 {0.1 * k} 0 0.5 0 0 0\n" for i in range(2)) for k in range(2)
)
RESTART = "MercuryDPM 1.0 name run\nxMin 0 xMax 4\nSpecies 1\nParticles 3\n" + "".join(
    f"BaseParticle id {i} indSpecies 0 position {i + 0.5} 0 0 velocity 0 0 0 radius 0.5 invMass 2\n" for i in range(3)
)
ROW = "0.1 {a} {b} 1 0 0 0.05 0 0.7 0 1 0 0 0 0 0\n"
FSTAT = "".join(
    f"# {0.1 * k} 1\n# 0 0 0 4 1 1\n# 0.5 0.5 0 0 0 0\n{ROW.format(a=0, b=1)}{ROW.format(a=1, b=0)}" for k in range(2)
)
LOCAL = "".join(
    f"ITEM: TIMESTEP\n{10 * k}\nITEM: NUMBER OF ENTRIES\n2\n{BOX}ITEM: ENTRIES c_1[1] c_1[2] c_2[1]\n1 2 0.5\n2 3 0.25\n"
    for k in range(2)
)
GRANULAR = LOCAL.replace("c_1[1] c_1[2] c_2[1]", "c_1[1] c_1[2] c_1[3]").replace("0.5\n", "0\n").replace("0.25", "1")
XYZ = "".join(
    f'2\nLattice="4 0 0 0 4 0 0 0 4" Properties=species:S:1:pos:R:3:velo:R:3:mass:R:1 pbc="T F F" Time={0.5 * k}\n'
    "H 0.5 0 0 0 0 0 1.0\nH 1.5 0 0 0 0 0 1.5\n"
    for k in range(2)
)  # fmt: skip


def swap(text, old, new, which=0):
    """The text with its ``which``-th occurrence of ``old`` replaced."""
    parts = text.split(old)
    assert len(parts) > which + 1, (old, text)
    return old.join(parts[: which + 1]) + new + old.join(parts[which + 1 :])


def second(old, new):
    """The two good frames with a change in the second one."""
    return dump(0) + swap(dump(1), old, new)


# name: (file name, content, words of the message)
PARTICLES = {
    # nothing, junk, cut gzip
    "no bytes": ("a.dump", "", "a.dump"),
    "one byte": ("a.dump", "I", "a.dump"),
    "binary junk": ("a.dump", bytes(range(256)) * 64, "a.dump"),
    "zero bytes": ("a.dump", bytes(100_000), "a.dump"),
    "a picture": ("a.dump", b"\x89PNG\r\n\x1a\n" + bytes(100), "a.dump"),
    "one endless line": ("a.dump", "ITEM: TIMESTEP " * 20_000, "a.dump"),
    "an endless line within": ("a.dump", GOOD + "ITEM: TIME" + " 1" * 100_000 + "\n", "lines of at most"),
    "gzip of nothing": ("a.dump.gz", gzip.compress(b""), "a.dump.gz"),
    "gzip of junk": ("a.dump.gz", gzip.compress(bytes(range(256))), "a.dump.gz"),
    "gzip cut in its head": ("a.dump.gz", gzip.compress(GOOD.encode())[:6], "a.dump.gz"),
    "gzip cut short": ("a.dump.gz", gzip.compress(os.urandom(3000).hex().encode())[:-500], "a.dump.gz"),
    "gzip with a bad sum": ("a.dump.gz", gzip.compress(GOOD.encode())[:-8] + bytes(8), "a.dump.gz"),
    "gzip head without gzip": ("a.dump", b"\x1f\x8bnot gzip at all", "a.dump"),
    "a word": ("a.dump", "hello\n", "a.dump"),
    "a table": ("a.csv", "x,y\n1,2\n", "a.csv"),
    # LAMMPS headers
    "no time step": ("a.dump", GOOD.replace("ITEM: TIMESTEP\n0\n", ""), "TIMESTEP"),
    "time step of a word": ("a.dump", swap(GOOD, "TIMESTEP\n0", "TIMESTEP\nten"), "frame 1: TIMESTEP"),
    "time step of a fraction": ("a.dump", swap(GOOD, "TIMESTEP\n10", "TIMESTEP\n10.5"), "frame 2: TIMESTEP"),
    "time step beyond integers": ("a.dump", swap(GOOD, "TIMESTEP\n10", "TIMESTEP\n" + "9" * 30), "frame 2: TIMESTEP"),
    "time of a word": ("a.dump", swap(GOOD, "TIME\n0.5", "TIME\nnow"), "frame 2: TIME"),
    "time nan": ("a.dump", swap(GOOD, "TIME\n0.5", "TIME\nnan"), "frame 2: TIME"),
    "time in one frame": ("a.dump", dump(0) + dump(1, time=False), "frame 2: time"),
    "no number of atoms": ("a.dump", GOOD.replace(f"ITEM: NUMBER OF ATOMS\n{N}\n", ""), "NUMBER OF ATOMS"),
    "atoms of a word": ("a.dump", swap(GOOD, f"ATOMS\n{N}", "ATOMS\nfour"), "frame 1: NUMBER OF ATOMS"),
    "negative atoms": ("a.dump", swap(GOOD, f"ATOMS\n{N}", "ATOMS\n-4"), "frame 1: NUMBER OF ATOMS"),
    "billions of atoms": ("a.dump", swap(GOOD, f"ATOMS\n{N}", "ATOMS\n4000000000"), "NUMBER OF ATOMS"),
    "billions of atoms in gzip": ("a.dump.gz", gzip.compress(swap(GOOD, f"ATOMS\n{N}", "ATOMS\n4000000000").encode()), "NUMBER OF ATOMS"),
    "atoms beyond integers": ("a.dump", swap(GOOD, f"ATOMS\n{N}", "ATOMS\n" + "9" * 40), "NUMBER OF ATOMS"),
    "one atom too many": ("a.dump", swap(GOOD, f"ATOMS\n{N}", f"ATOMS\n{N + 1}"), "frame 1: rows"),
    "one atom too few": ("a.dump", swap(GOOD, f"ATOMS\n{N}", f"ATOMS\n{N - 1}"), "frame 1: NUMBER OF ATOMS"),
    "no atoms": ("a.dump", dump(0, rows=[], n=0), "frame 1: particles"),
    "a tilted box": ("a.dump", GOOD.replace("BOUNDS pp ff ff\n0 4\n-1 1\n-1 1", "BOUNDS xy xz yz pp pp pp\n0 4 1\n-1 1 0\n-1 1 0"), "BOX BOUNDS"),
    "a general box": ("a.dump", GOOD.replace("BOUNDS pp ff ff\n0 4\n-1 1\n-1 1", "BOUNDS abc origin\n4 0 0 0\n0 1 0 0\n0 0 1 0"), "BOX BOUNDS"),
    "a box of words": ("a.dump", swap(GOOD, "0 4\n", "zero four\n"), "frame 1: BOX BOUNDS"),
    "a box inside out": ("a.dump", swap(GOOD, "0 4\n", "4 0\n"), "frame 1: BOX BOUNDS"),
    "an infinite box": ("a.dump", swap(GOOD, "0 4\n", "0 inf\n"), "frame 1: BOX BOUNDS"),
    "half a box": ("a.dump", swap(GOOD, "0 4\n", "0\n"), "frame 1: BOX BOUNDS"),
    "columns without names": ("a.dump", GOOD.replace("ATOMS id mass x vx", "ATOMS"), "ATOMS"),
    "a column twice": ("a.dump", GOOD.replace("id mass x vx", "id x x vx"), "frame 1: ATOMS"),
    "columns that change": ("a.dump", dump(0) + dump(1).replace("id mass x vx", "id mass xu vx"), "frame 2: columns"),
    "no ids": ("a.dump", GOOD.replace("id mass x vx", "type mass x vx"), "frame 1: id"),
    "no positions": ("a.dump", GOOD.replace("id mass x vx", "id mass q vx"), "frame 1: positions"),
    "scaled positions without a box": ("a.dump", GOOD.replace("mass x vx", "mass xs vx").replace(BOX, ""), "BOX BOUNDS"),
    # LAMMPS rows
    "a word for an id": ("a.dump", second("2 1.1", "two 1.1"), "frame 2: id"),
    "a fraction for an id": ("a.dump", second("2 1.1", "2.5 1.1"), "frame 2: id"),
    "an id beyond integers": ("a.dump", second("2 1.1", "9" * 25 + " 1.1"), "frame 2: id"),
    "a word for a mass": ("a.dump", second("2 1.1", "2 heavy"), "frame 2: mass"),
    "mass nan": ("a.dump", swap(GOOD, "2 1.1", "2 nan"), "frame 1: mass"),
    "mass zero": ("a.dump", swap(GOOD, "2 1.1", "2 0"), "frame 1: mass"),
    "negative mass": ("a.dump", swap(GOOD, "2 1.1", "2 -1"), "frame 1: mass"),
    "position nan": ("a.dump", second("1.51", "nan"), "frame 2: x"),
    "position infinite": ("a.dump", second("1.51", "-inf"), "frame 2: x"),
    "position beyond floats": ("a.dump", second("1.51", "1e999"), "frame 2: x"),
    "position with a comma": ("a.dump", second("1.51", "1,51"), "frame 2: x"),
    "position with an underscore": ("a.dump", second("1.51", "1_51"), "frame 2: x"),
    "position in Fortran's way": ("a.dump", second("1.51", "1.51d0"), "frame 2: x"),
    "velocity of a word": ("a.dump", second("1.51 0.0", "1.51 fast"), "frame 2: vx"),
    "a zero byte in a row": ("a.dump", second("1.51", "1.\x0051"), "frame 2: x"),
    "a short row": ("a.dump", second("2 1.1 1.51 0.0", "2 1.1 1.51"), "frame 2: row 2"),
    "a long row": ("a.dump", second("2 1.1 1.51 0.0", "2 1.1 1.51 0.0 7"), "frame 2: row 2"),
    "all rows long": ("a.dump", dump(0, rows=[f"{i} 1 {i} 0 7" for i in range(N)]), "frame 1: row 1"),
    "all rows short": ("a.dump", dump(0, rows=[f"{i} 1 {i}" for i in range(N)]), "frame 1: row 1"),
    "an empty row": ("a.dump", second("2 1.1 1.51 0.0", ""), "frame 2: row 2"),
    "a quoted row": ("a.dump", second("2 1.1 1.51 0.0", '2 "1.1 1.51" 0.0'), "frame 2: mass"),
    # frames that do not belong together
    "an id twice": ("a.dump", second("3 1.2", "2 1.2"), "frame 2: id"),
    "another id": ("a.dump", second("3 1.2", "9 1.2"), "frame 2: id"),
    "a particle lost": ("a.dump", dump(0) + dump(1, rows=[f"{i + 1} 1 {i} 0" for i in range(3)], n=3), "frame 2: id"),
    "a mass that changes": ("a.dump", second("3 1.2", "3 1.25"), "frame 2: masses"),
    "frames out of order": ("a.dump", dump(1) + dump(0), "frame 2: step"),
    "a frame twice": ("a.dump", dump(0) + dump(0), "frame 2: step"),
    "times out of order": ("a.dump", dump(0) + swap(dump(1), "TIME\n0.5", "TIME\n-1"), "frame 2: time"),
    "cut within the only frame": ("a.dump", dump(0)[:-12], "frame 1"),
    "cut within the first header": ("a.dump", dump(0)[:40], "frame 1"),
    "contacts for particles": ("a.dump", LOCAL, "a.dump"),
    # MercuryDPM
    "mercury: a header of words": ("a.data", swap(DATA, "3 0.1 0", "3 soon 0"), "frame 2: header"),
    "mercury: a header too short": ("a.data", swap(DATA, "3 0.1 0 0 0 4 1 1", "3 0.1 0 0 0 4 1"), "frame 2: header"),
    "mercury: half a particle": ("a.data", swap(DATA, "3 0.1 0", "2.5 0.1 0"), "frame 2: N"),
    "mercury: negative N": ("a.data", swap(DATA, "3 0.0 0", "-3 0.0 0"), "frame 1: N"),
    "mercury: billions": ("a.data", swap(DATA, "3 0.0 0", "3e9 0.0 0"), "frame 1: N"),
    "mercury: N infinite": ("a.data", swap(DATA, "3 0.1 0", "inf 0.1 0"), "frame 2: header"),
    "mercury: one too few": ("a.data", swap(DATA, "3 0.0 0", "2 0.0 0"), "frame 2: header"),
    "mercury: one too many": ("a.data", swap(DATA, "3 0.0 0", "4 0.0 0"), "a.data"),
    "mercury: a domain inside out": ("a.data", swap(DATA, "0 0 0 4 1 1", "9 0 0 4 1 1"), "frame 1: header"),
    "mercury: time backwards": ("a.data", swap(DATA, "3 0.1 0", "3 -0.1 0"), "frame 2: time"),
    "mercury: a row short": ("a.data", swap(DATA, "1.5 0 0 0.1 0 0 0.5 0", "1.5 0 0 0.1 0 0 0.5"), "frame 2: row 2"),
    "mercury: radius of a word": ("a.data", swap(DATA, "1.5 0 0 0.1 0 0 0.5", "1.5 0 0 0.1 0 0 big"), "frame 2: radius"),
    "mercury: negative radius": ("a.data", swap(DATA, "1.5 0 0 0.0 0 0 0.5", "1.5 0 0 0.0 0 0 -0.5"), "frame 1: radius"),
    "mercury: radius that changes": ("a.data", swap(DATA, "1.5 0 0 0.1 0 0 0.5", "1.5 0 0 0.1 0 0 0.6"), "frame 2: radii"),
    "mercury: velocity nan": ("a.data", swap(DATA, "1.5 0 0 0.1", "1.5 0 0 nan"), "frame 2: vx"),
    "mercury: a column less": ("a.data", DATA.replace("0 0 0 0 0 0 0\n", "0 0 0 0 0 0\n"), "frame 1: row 1"),
    "mercury: flat, one column more": ("a.data", FLAT.replace("0.5 0 0 0\n", "0.5 0 0 0 0\n"), "frame 1: row 1"),
    "mercury: cut in the only frame": ("a.data", DATA[:60], "frame 1"),
}  # fmt: skip

XYZS = {
    "xyz: a count of words": ("a.xyz", "2 atoms\n" + XYZ[2:], "a.xyz"),
    "xyz: billions": ("a.xyz", swap(XYZ, "2\nLattice", "2000000000\nLattice"), "frame 1: line 1"),
    "xyz: one too few": ("a.xyz", swap(XYZ, "2\nLattice", "1\nLattice"), "frame 2: line 1"),
    "xyz: a tilted box": ("a.xyz", XYZ.replace("4 0 0 0 4 0", "4 1 0 0 4 0"), "frame 1: Lattice"),
    "xyz: a word in a row": ("a.xyz", swap(XYZ, "H 1.5", "H far"), "frame 1: rows"),
    "xyz: position nan": ("a.xyz", swap(XYZ, "H 1.5", "H nan"), "frame 1: x"),
    "xyz: a short row": ("a.xyz", swap(XYZ, "H 1.5 0 0 0 0 0 1.5", "H 1.5 0 0"), "frame 1: rows"),
    "xyz: time of a word": ("a.xyz", swap(XYZ, "Time=0.5", "Time=late"), "frame 2: Time"),
    "xyz: time backwards": ("a.xyz", swap(XYZ, "Time=0.5", "Time=-0.5"), "frame 2: time"),
    "xyz: properties of no kind": ("a.xyz", swap(XYZ, "pos:R:3", "pos:Q:3"), "frame 1: rows"),
    "xyz: billions of columns": ("a.xyz", swap(XYZ, "pos:R:3", "pos:R:" + "9" * 12), "frame 1: Properties"),
    "xyz: masses in threes": ("a.xyz", XYZ.replace("velo:R:3:mass:R:1", "velo:R:1:mass:R:3"), "frame 1: "),
    "xyz: cut in the only frame": ("a.xyz", XYZ[:110], "frame 1"),
}


def use_all(path, **options):
    """Everything that is in a file."""
    frames = read_frames(path, **options)
    for frame in frames:
        assert frame.positions.isfinite().all()
    return frames


def refused(call, words, *more):
    with pytest.raises((checks.FieldError, checks.FieldTypeError)) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message
    assert len(message) < 500
    for word in (words, *more):
        assert word in message, message
    assert " must " in message
    return message


@pytest.fixture
def written(tmp_path):
    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def test_the_good_files_are_good(written):
    for name, content, n in (("a.dump", GOOD, N), ("a.data", DATA, 3), ("b.data", FLAT, 2)):
        frames = use_all(written(name, content))
        assert len(frames) == 2
        assert len(frames.ids) == n
    assert len(PARTICLES) + len(XYZS) + len(CONTACTS) + len(RESTARTS) + len(NETCDF) > 120


@pytest.mark.parametrize("case", PARTICLES)
def test_bad_files_of_particles(case, written):
    name, content, words = PARTICLES[case]
    refused(lambda: use_all(written(name, content)), words, name)


@pytest.mark.skipif(not HAS_ASE, reason="needs the extra xyz")
@pytest.mark.parametrize("case", XYZS)
def test_bad_extended_xyz(case, written):
    name, content, words = XYZS[case]
    assert len(use_all(written("good.xyz", XYZ))) == 2
    refused(lambda: use_all(written(name, content)), words, name)


def test_xyz_without_ase_says_what_to_install(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "ase.io", None)
    refused(lambda: read_frames(written("a.xyz", XYZ)), "torchchain[xyz]")


# Contacts

CONTACTS = {
    "no bytes": ("a.fstat", "", "contacts"),
    "junk": ("a.fstat", bytes(range(256)), "a.fstat"),
    "particles for contacts": ("a.fstat", DATA, "a.fstat"),
    "a header line missing": ("a.fstat", swap(FSTAT, "# 0 0 0 4 1 1\n", ""), "frame 1: header"),
    "time of a word": ("a.fstat", swap(FSTAT, "# 0.1 1", "# late 1"), "frame 2: time"),
    "no time": ("a.fstat", swap(FSTAT, "# 0.1 1", "#"), "frame 2: time"),
    "another time": ("a.fstat", FSTAT.replace("# 0.1 1", "# 7 1").replace("# 0.0 1", "# 6 1"), "a.fstat: time"),
    "a time twice": ("a.fstat", swap(FSTAT, "# 0.1 1", "# 0.0 1"), "frame 2: time"),
    "a short row": ("a.fstat", swap(FSTAT, "0.7 0 1 0 0 0 0 0\n", "0.7 0 1 0 0\n"), "frame 1: row 1"),
    "id of a word": ("a.fstat", swap(FSTAT, "0.1 0 1 1", "0.1 zero 1 1"), "frame 1: id1"),
    "id of nobody": ("a.fstat", FSTAT.replace("0.1 0 1 1", "0.1 7 1 1"), "frame 1: id1"),
    "id beyond all": ("a.fstat", FSTAT.replace("0.1 0 1 1", f"0.1 {2**40} 1 1"), "frame 1: id1"),
    "a particle with itself": ("a.fstat", FSTAT.replace("0.1 0 1 1", "0.1 1 1 1"), "frame 1: contacts"),
    "overlap nan": ("a.fstat", swap(FSTAT, "0.05 0 0.7", "nan 0 0.7"), "frame 1: overlap"),
    "force infinite": ("a.fstat", swap(FSTAT, "0.05 0 0.7", "0.05 0 inf"), "frame 1: normal_force"),
}  # fmt: skip


@pytest.mark.parametrize("case", CONTACTS)
def test_bad_contacts_of_mercury(case, written):
    name, content, words = CONTACTS[case]
    data = written("run.data", DATA)
    assert len(use_all(data, contacts=written("good.fstat", FSTAT)).contacts.pairs) == 1
    refused(lambda: use_all(data, contacts=written(name, content)), words)


@pytest.mark.parametrize("base", [LOCAL, GRANULAR], ids=["lammps", "liggghts"])
@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("ITEM: TIMESTEP\n0\n", "", "TIMESTEP"),
        ("ENTRIES\n2", "ENTRIES\n3", "frame 1: rows"),
        ("ENTRIES\n2", "ENTRIES\n1", "frame 1: NUMBER OF ENTRIES"),
        ("ENTRIES\n2", "ENTRIES\n2000000000", "NUMBER OF ENTRIES"),
        ("1 2 0", "1 2.5 0", "frame 1: columns"),
        ("1 2 0", "2 2 0", "frame 1: columns"),
        ("1 2 0", "1 9 0", "frame 1: id2"),
        ("1 2 0", "nan 2 0", "frame 1: c_1[1]"),
        ("1 2 0", "1 2 x", "frame 1: "),
        ("1 2 0", "1 2 0 1 ", "frame 1: row 1"),
    ],
)
def test_bad_contact_lists(base, old, new, words, written):
    path = written("run.dump", GOOD)
    assert len(use_all(path, contacts=written("good.local", base)).contacts.pairs) == 2
    refused(lambda: use_all(path, contacts=written("a.local", swap(base, old, new))), words, "a.local")


RESTARTS = {
    "junk": ("\x00\x01junk", "run.restart"),
    "another file": ("hello\n", "run.restart"),
    "no particles": (RESTART.partition("Particles")[0], "run.restart"),
    "fewer than announced": (RESTART.replace("Particles 3", "Particles 4"), "run.restart: Particles"),
    "fewer than in the data": (RESTART.replace("Particles 3", "Particles 2"), "run.restart: Particles"),
    "billions": (RESTART.replace("Particles 3", "Particles 3000000000"), "run.restart: Particles"),
    "another radius": (swap(RESTART, "radius 0.5", "radius 0.6"), "run.restart: radius"),
    "a mass of words": (swap(RESTART, "invMass 2", "invMass light"), "invMass"),
    "no masses": (RESTART.replace("invMass 2", ""), "invMass"),
    "a negative mass": (swap(RESTART, "invMass 2", "invMass -2"), "invMass"),
    "an id beyond integers": (swap(RESTART, "id 1", "id " + "9" * 20), "id"),
    "cut short": (RESTART[:-5], "run.restart"),
}


@pytest.mark.parametrize("case", RESTARTS)
def test_bad_restarts(case, written):
    """Refused when asked for; a warning where the file only lies beside the data."""
    content, words = RESTARTS[case]
    data = written("run.data", DATA)
    assert read_frames(data, masses=str(written("good.restart", RESTART))).masses.tolist() == [0.5, 0.5, 0.5]
    path = written("run.restart", content)
    refused(lambda: read_frames(data, masses=str(path)), words)
    with pytest.warns(FramesWarning, match="run.data, frame 1: masses"):
        frames = read_frames(data)
    refused(frames.chain, "masses", "run.data, frame 1")


# netCDF

def announce(file, shape):
    """Positions of another shape, none of them stored."""
    axes = file["position"].attrs["axes"]
    del file["position"]
    file.create_dataset("position", shape, "f8", chunks=(1, min(1000, shape[1]), 1)).attrs["axes"] = axes


NETCDF = {
    "billions of frames": (lambda file: announce(file, (10**11, N, 1)), "position"),
    "billions of particles": (lambda file: announce(file, (2, 10**11, 1)), "position"),
    "billions of contacts": (lambda file: file["contact_frame"].resize((10**11,)), "contact_frame"),
    "another netCDF": (lambda file: file.attrs.__setitem__("layout", "none"), "layout"),
    "no ids": (lambda file: file.__delitem__("id"), "layout"),
    "other axes": (lambda file: file["position"].attrs.__setitem__("axes", "q"), "position"),
    "a mass nan": (lambda file: file["mass"].__setitem__(1, float("nan")), "frame 1: mass"),
    "a mass of zero": (lambda file: file["mass"].__setitem__(1, 0), "frame 1: mass"),
    "a position nan": (lambda file: file["position"].__setitem__((1, 2, 0), float("nan")), "frame 2: x"),
    "times out of order": (lambda file: file["time"].__setitem__(1, -1), "frame 2: time"),
    "a time nan": (lambda file: file["time"].__setitem__(1, float("nan")), "frame 2: time"),
    "an id twice": (lambda file: file["id"].__setitem__(1, 1), "frame 1: id"),
    "words for masses": (lambda file: (file.__delitem__("mass"), file.__setitem__("mass", [b"a"] * N)), "mass"),
    "fewer masses": (lambda file: (file.__delitem__("mass"), file.__setitem__("mass", [1.0])), "mass"),
    "half a box": (lambda file: file.__delitem__("box_upper"), "box"),
    "contacts of nobody": (lambda file: file["contact_pair"].__setitem__((0, 0), 99), "contact_pair"),
}


@pytest.mark.parametrize("case", NETCDF)
def test_bad_netcdf(case, written, tmp_path):
    damage, words = NETCDF[case]
    path = convert(written("a.dump", GOOD), tmp_path / "a.nc", contacts=written("a.local", LOCAL))
    assert len(use_all(path)) == 2
    with h5py.File(path, "a") as file:
        damage(file)
    refused(lambda: use_all(path), words, "a.nc")


def test_netcdf_cut_short(written, tmp_path):
    path = convert(written("a.dump", GOOD), tmp_path / "a.nc")
    whole = path.read_bytes()
    for size in (9, 100, len(whole) // 2):
        path.write_bytes(whole[:size])
        refused(lambda: use_all(path), "a.nc")


# Places and options


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("nowhere.dump", "path must"),
        (".", "path must"),
        ("no*.dump", "path must match"),
        ("a\0b", "path must"),
        ([], "path must"),
        (7, "path must"),
        (None, "path must"),
        (["nowhere"], "path must"),
    ],
)
def test_places_that_hold_no_frames(path, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(lambda: read_frames(path), words)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"format": "vtk"}, "format"),
        ({"format": "mercury"}, "frame 1"),
        ({"format": "netcdf"}, "a.dump"),
        ({"format": 3}, "format"),
        ({"time_step": 0}, "time_step"),
        ({"time_step": "1"}, "time_step"),
        ({"time_step": 1.0}, "time_step"),
        ({"masses": 2.0}, "masses"),
        ({"masses": "nowhere.restart"}, "masses"),
        ({"density": -1}, "density"),
        ({"density": 1.0}, "density"),
        ({"density": 1.0, "masses": 1.0}, "density"),
        ({"periodic": "q"}, "periodic"),
        ({"periodic": True}, "periodic"),
        ({"colour": "red"}, "options"),
        ({"contacts": "nowhere.local"}, "contacts"),
    ],
)
def test_options_that_cannot_be(options, words, written):
    refused(lambda: read_frames(written("a.dump", GOOD), **options), words)


@pytest.mark.parametrize(
    "masses", [0.0, -1.0, float("nan"), [1.0], [[1.0] * N], "word", {1: 1.0}, {}, True, [1.0, 2.0, 3.0, 0.0]], ids=str
)
def test_masses_that_cannot_be(masses, written):
    path = written("a.dump", GOOD.replace("id mass x vx", "id q x vx"))
    assert read_frames(path, masses=2.0).masses.tolist() == [2.0] * N
    refused(lambda: read_frames(path, masses=masses), "" if isinstance(masses, dict) else "masses")


@pytest.mark.parametrize(
    "columns",
    [{"id1": "c_1[1]"}, {"id1": "c_1[1]", "id2": "c_9"}, {"who": "c_1[1]"}, "vel", "id id", 7, "id pos"],
    ids=str,
)
def test_contact_columns_that_cannot_be(columns, written):
    path = written("a.dump", GOOD)
    for base in (LOCAL, GRANULAR):
        local = written("a.local", base)
        refused(lambda local=local: use_all(path, contacts=local, contact_columns=columns), "col")


def test_a_conversion_leaves_nothing_half_written(written, tmp_path):
    before = written("bad.dump", second("1.51", "nan"))
    out = tmp_path / "new" / "a.nc"
    out.parent.mkdir()
    refused(lambda: convert(before, out), "frame 2: x")
    assert list(out.parent.iterdir()) == []
    good = written("good.dump", GOOD)
    for place in (good, tmp_path, tmp_path / "nowhere" / "a.nc"):
        refused(lambda place=place: convert(good, place), "out")
    assert good.read_text() == GOOD


def test_memory_stays_bounded_whatever_is_announced(tmp_path):
    """A gzip file of zeros, some hundred times its size, and one that announces more rows than it has."""
    bomb, more = tmp_path / "bomb.dump.gz", tmp_path / "more.dump.gz"
    bomb.write_bytes(gzip.compress(bytes(1 << 27), 1))
    more.write_bytes(gzip.compress((swap(GOOD, f"ATOMS\n{N}", "ATOMS\n20000000")[:-4] + "0\n" * (1 << 26)).encode(), 1))
    code = (
        "import resource, sys\n"
        "from torchchain.frames import read_frames\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "for path in sys.argv[1:]:\n"
        "    try:\n"
        "        read_frames(path)\n"
        "    except ValueError as error:\n"
        "        print(str(error))\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(bomb), str(more)], capture_output=True, text=True, check=False
    )
    *lines, grown = done.stdout.splitlines()
    assert len(lines) == 2, done.stderr
    assert int(grown) < 96  # MB; both files hold 128


def test_every_format_has_a_bad_file():
    assert set(FORMATS) == {"lammps", "mercury", "xyz", "netcdf", "lammps_local", "liggghts_local", "mercury_fstat"}
