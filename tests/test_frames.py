"""Trajectories of other codes: LAMMPS's own runs, every way to write a dump, contacts, units, and what is doubtful."""

from __future__ import annotations

import doctest
import gzip
import importlib
import importlib.util
import itertools
import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain import checks
from torchchain.frames import FORMATS, ContactUnits, FramesWarning, check_energy, check_opening, convert, read_frames

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "experiments"))

import lammps_chains

STORED = Path(__file__).parent / "data" / "lammps"
N, SIDE, TIMES = 10, 10.0, 6


@pytest.fixture(autouse=True)
def no_doubts():
    """A warning that a test does not expect is a failure."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", FramesWarning)
        yield


def made(n=N, times=TIMES, amplitude=0.03, seed=3):
    """A chain at rest at 0.5, 1.5, ... and its motion, by the library: chain, Trajectory."""
    masses = tc.Disorder(strength=0.1).masses(n, 1, seed)[0]
    chain = tc.Chain(masses / masses.mean())
    state = tc.standing_wave(chain, tone=2, amplitude=amplitude) + tc.impulse(chain, site=4, velocity=amplitude)
    return chain, tc.evolve(chain, state, torch.arange(times, dtype=torch.float64))


def rest(n=N):
    return torch.arange(n, dtype=torch.float64) + 0.5


def dump(
    chain,
    path,
    columns="id mass xu vx",
    shift=0.0,
    seed=None,
    box="pp ff ff",
    side=SIDE,
    form=".17g",
    time=True,
    values=None,
):
    """A LAMMPS dump of the motion, moved by ``shift`` and wrapped where the columns say so."""
    generator = np.random.default_rng(seed)
    text = []
    for k in range(len(path.times)):
        x = rest(chain.n_particles) + path.displacement[k] + shift
        image = torch.floor(x / side)
        known = {
            "id": range(1, chain.n_particles + 1), "type": [1] * chain.n_particles, "element": ["Si"] * chain.n_particles, "mass": chain.masses.tolist(),
            "xu": x.tolist(), "x": (x - side * image).tolist(), "xs": ((x - side * image) / side).tolist(), "xsu": (x / side).tolist(),
            "ix": [int(i) for i in image], "vx": path.velocity[k].tolist(), "y": [0.25] * chain.n_particles, "vy": [0.0] * chain.n_particles,
            "radius": [0.55] * chain.n_particles, "diameter": [1.1] * chain.n_particles, **(values or {}),
        }  # fmt: skip
        rows = [
            " ".join(format(v, form) if isinstance(v, float) else str(v) for v in row)
            for row in zip(*(known[c] for c in columns.split()), strict=True)
        ]
        if seed is not None:
            generator.shuffle(rows)
        head = f"ITEM: TIME\n{path.times[k]:.17g}\n" if time else ""
        text.append(
            f"{head}ITEM: TIMESTEP\n{100 * k}\nITEM: NUMBER OF ATOMS\n{len(rows)}\nITEM: BOX BOUNDS {box}\n0 {side}\n-1 1\n-1 1\nITEM: ATOMS {columns}\n"
            + "".join(f"{row} \n" for row in rows)
        )
    return text


@pytest.fixture
def motion():
    return made()


@pytest.fixture
def file(tmp_path):
    numbers = itertools.count()

    def write(text, name=None):
        path = tmp_path / (name or f"{next(numbers)}.dump")
        content = "".join(text).encode()
        path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
        return path

    return write


@pytest.fixture
def at_rest(motion, file):
    """The reference: the chain at rest, in one frame."""
    chain, path = motion
    still = tc.Trajectory(
        path.times[:1], torch.zeros(1, N, dtype=torch.float64), torch.zeros(1, N, dtype=torch.float64)
    )

    def write(columns="id xu vx", shift=0.0, **settings):
        return file(dump(chain, still, columns, shift, **settings), "reference.dump")

    return write


# Runs by LAMMPS


@pytest.mark.parametrize("number", range(len(lammps_chains.groups(lammps_chains.SMOKE))))
def test_lammps_runs_are_the_librarys(number):
    """Masses to the last bit, displacements to what rounding leaves of the same integrator, LAMMPS's own kinetic energy."""
    config = lammps_chains.SMOKE
    group = lammps_chains.groups(config)[number]
    ours = lammps_chains.chains(config, group)
    state = lammps_chains.start(config, ours)
    made, paths = lammps_chains.imported(config, STORED, group)
    for i, (chain, path) in enumerate(zip(made, paths, strict=True)):
        r, s = divmod(i, config.n_bands)
        assert torch.equal(chain.masses, ours.masses[r])
        own = tc.State(state.displacement[r, s], state.velocity[r, s])
        same = tc.evolve(chain, own, path.times, method="verlet", step=group.time_step)
        assert (path.displacement - same.displacement).abs().max() < 1e-9 * same.displacement.abs().max()
    assert lammps_chains.kinetic_error(STORED, group, made, paths) < 1e-12


def test_band_energies_of_lammps_are_exact_to_a_millionth():
    """And their difference is of second order in LAMMPS's time step."""
    config = lammps_chains.SMOKE
    coarse, fine = (lammps_chains.of_step(config, STORED, group)[0] for group in lammps_chains.groups(config)[2:])
    assert fine < 1e-6
    assert coarse / fine == pytest.approx(4, rel=0.01)


@pytest.mark.skipif(importlib.util.find_spec("lammps") is None, reason="needs the extra dem")
def test_lammps_makes_the_stored_dumps_again(tmp_path):
    lammps_chains.compute(lammps_chains.SMOKE, tmp_path)
    names = sorted(path.name for path in STORED.iterdir())
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    for name in names:
        if name.endswith(".gz"):
            old, new = read_frames(STORED / name), read_frames(tmp_path / name)
            assert torch.equal(old.masses, new.masses)
            assert (old.positions - new.positions).abs().max() < 1e-10


@pytest.mark.filterwarnings("ignore::torchchain.PredictionWarning")
def test_a_master_equation_from_imported_energies_is_as_good_as_the_ensemble():
    """Energies by the library stand for dumps; the second half of the chains is not seen by the fit."""
    config = replace(lammps_chains.Config(), n_particles=32, n_bands=4, realizations=40)
    ours = lammps_chains.chains(config, lammps_chains.groups(config)[0])
    state, times = lammps_chains.start(config, ours), torch.arange(0, 20, 0.5, dtype=torch.float64)
    path = tc.evolve(ours, state, times)
    made = [replace(ours, masses=masses) for masses in ours.masses for _ in range(4)]
    paths = [
        tc.Trajectory(times, *run)
        for run in zip(path.displacement.flatten(0, 1), path.velocity.flatten(0, 1), strict=True)
    ]
    found, _ = lammps_chains.of_ensemble(config, made, paths)
    assert found["entrances"] < 1e-12
    assert 0 < found["trajectories_distance"] < 1.25 * found["halves_distance"]
    assert 0 < found["energies_distance"] < 1.25 * found["halves_distance"]


# Every way to write a dump


@pytest.mark.parametrize("seed", [None, 5])
@pytest.mark.parametrize(
    "columns", ["id mass xu vx", "vx xu mass id", "id mass x vx", "ix id x mass vx", "id element mass xs vx type", "mass xsu id vx", "id xs ix mass vx radius", "xu id x mass vx y vy diameter"]
)  # fmt: skip
def test_every_way_to_write_a_dump_gives_the_same(columns, seed, motion, file, at_rest):
    """Some particles cross the box, the rows come in any order, and the displacement is what the library made."""
    chain, path = motion
    frames = read_frames(file(dump(chain, path, columns, shift=-0.52, seed=seed)))
    found = frames.trajectory(at_rest("id xu vx y vy" if " y " in columns else "id xu vx", shift=-0.52))
    assert torch.equal(found.times, path.times)
    # Wrapped ones begin their order elsewhere on the ring, unless their ids ascend from there, as here.
    assert (found.displacement - path.displacement).abs().max() < 1e-13 * SIDE
    assert torch.equal(found.velocity, path.velocity)
    assert torch.equal(frames.chain().masses, chain.masses)
    assert frames.chain().boundary == "periodic"
    if "radius" in columns or "diameter" in columns:
        assert (frames.radii - 0.55).abs().max() < 1e-15


def test_particles_go_round_the_box(motion, file):
    """A whole ring that drifts around it twice, wrapped: the displacement goes on."""
    chain, path = motion
    drift = 4.0 * torch.arange(TIMES, dtype=torch.float64)[:, None]
    moving = replace(path, displacement=path.displacement + drift)
    found = read_frames(file(dump(chain, moving, "id mass x vx"))).trajectory()
    assert (found.displacement - (moving.displacement - moving.displacement[0])).abs().max() < 1e-12 * SIDE


def test_times_from_a_time_step(motion, file):
    chain, path = motion
    written = file(dump(chain, path, time=False))
    frames = read_frames(written)
    assert frames.steps.tolist() == [100 * k for k in range(TIMES)]
    for ask in (lambda: frames.times, frames.trajectory):
        with pytest.raises(checks.FieldError, match="TIME must be in the file"):
            ask()
    frames = read_frames(written, time_step=0.01)
    assert frames.times.tolist() == [float(k) for k in range(TIMES)]
    assert frames.trajectory().times.tolist() == frames.times.tolist()


def test_gzip_files_of_one_frame_each_and_lists(motion, file, tmp_path):
    """A pattern takes the numbers in names as numbers: 2 comes before 10."""
    chain, path = motion
    text = dump(chain, path)
    whole = read_frames(file(text, "whole.dump.gz"))
    for k, frame in enumerate(text):
        file(frame, f"part.{2 * k}.dump.gz" if k % 2 else f"part.{2 * k}.dump")
    parts = read_frames(str(tmp_path / "part.*.dump*"))
    listed = read_frames([tmp_path / "part.0.dump", str(tmp_path / "part.2.dump.gz")])
    assert len(parts) == TIMES
    assert torch.equal(parts.positions, whole.positions)
    assert torch.equal(listed.velocities, whole.velocities[:2])
    assert "6 frames of 10 particles" in repr(parts)


def test_frames_are_a_sequence(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(chain, path)))
    assert [frame.number for frame in frames] == [1, 2, 3, 4, 5, 6]
    assert frames[-1].number == 6
    assert frames[2].time == 2.0
    assert [frame.number for frame in frames[1::2]] == [2, 4, 6]
    assert torch.equal(frames[1::2].times, torch.tensor([1.0, 3.0, 5.0], dtype=torch.float64))
    assert frames[3:].trajectory().displacement.shape == (3, N)
    assert frames.box.periodic == (True, False, False)
    assert frames.box.lengths.tolist() == [10.0, 2.0, 2.0]
    assert frames.positions.dtype == torch.float64
    for index in (6, -7, 1.5, "1"):
        with pytest.raises((checks.FieldError, checks.FieldTypeError), match="index"):
            frames[index]
    with pytest.raises(checks.FieldError, match="frames must be at least one"):
        frames[9:]


def test_one_frame_is_in_memory_at_a_time(motion, file, monkeypatch):
    """Opening reads one frame; going through them never asks for the next before it is wanted."""
    chain, path = motion
    seen, read = [], FORMATS["lammps"].read

    def counted(*args):
        for raw in read(*args):
            seen.append(len(seen))
            yield raw

    monkeypatch.setitem(FORMATS, "lammps", replace(FORMATS["lammps"], read=counted))
    frames = read_frames(file(dump(chain, path)))
    assert len(seen) == 1
    going = iter(frames)
    next(going)
    next(going)
    assert len(seen) == 3


def test_the_example_of_the_manual(file):
    """Three frames of eight particles, time first, one coordinate."""
    rows = "".join(f"{i + 1} {1 + 0.1 * (i % 3)} {i + 0.5 + (0.001 if i == 3 else 0)} 0.0\n" for i in range(8))
    block = "ITEM: TIME\n{t}\nITEM: TIMESTEP\n{n}\nITEM: NUMBER OF ATOMS\n8\nITEM: BOX BOUNDS pp ff ff\n0 8\n-5 5\n-5 5\nITEM: ATOMS id mass xu vx\n"
    frames = read_frames(file(block.format(t=t, n=10 * t) + rows for t in (0, 1, 2)))
    chain, path = frames.chain(boundary="periodic", stiffness=1.0), frames.trajectory(reference=None)
    assert frames.masses.shape == (8,)
    assert chain.masses.shape == (8,)
    assert path.displacement.shape == (3, 8)


# Order, references, walls


def test_order_is_that_along_the_axis_whatever_the_ids(motion, file):
    chain, path = motion
    ids = torch.randperm(N, generator=torch.Generator().manual_seed(1)) + 1
    frames = read_frames(file(dump(chain, path, "id mass xu vx", values={"id": ids.tolist()})))
    assert frames.ids.tolist() == list(range(1, N + 1))
    assert torch.equal(frames.chain().masses, chain.masses)
    assert torch.equal(frames.trajectory().velocity, path.velocity)
    together = frames.trajectory(axis="all")
    assert together.displacement.shape == (TIMES, N, 1)
    assert torch.equal(together.velocity[:, ids - 1, 0], path.velocity)


def test_particles_in_the_plane_move_as_vectors(motion, file):
    chain, path = motion
    heights = [3.0 * (i % 3) for i in range(N)]
    frames = read_frames(file(dump(chain, path, "id mass xu y vx vy", values={"y": heights})))
    found = frames.trajectory()
    assert found.displacement.shape == (TIMES, N, 2)
    assert torch.equal(found.velocity[..., 0], path.velocity)
    with pytest.raises(checks.FieldError, match="positions must lie on a line"):
        frames.chain()
    assert torch.equal(frames.chain(axis="x").masses, chain.masses)
    for axis, words in (("z", "z must be in the file"), ("q", "axis must be one of"), (1, "axis must be a string")):
        with pytest.raises((checks.FieldError, checks.FieldTypeError), match=words):
            frames.trajectory(axis=axis)


def test_references(motion, file, at_rest):
    chain, path = motion
    frames = read_frames(file(dump(chain, path)))
    still = at_rest()
    from_path = frames.trajectory(still).displacement
    assert (from_path - path.displacement).abs().max() < 1e-14 * SIDE
    assert torch.equal(frames.trajectory(read_frames(still)).displacement, from_path)
    assert torch.equal(frames.trajectory(still).displacement, from_path)
    assert torch.equal(frames.trajectory().displacement[0], torch.zeros(N, dtype=torch.float64))
    with pytest.raises(checks.FieldError, match="frames must be one for a reference"):
        frames.trajectory(frames)
    with pytest.raises(checks.FieldError, match="path must be a file"):
        frames.trajectory("nowhere.dump")
    other, moved = made(n=N - 1)
    with pytest.raises(checks.FieldError, match="reference.dump, frame 1: ids must be those of"):
        frames.trajectory(file(dump(other, moved)[:1], "reference.dump"))
    with pytest.raises(checks.FieldError, match="positions must be along x"):
        frames.trajectory(at_rest("id xu y"))
    with pytest.raises(checks.FieldError, match="masses must be those of"):
        frames.trajectory(at_rest("id xu mass", values={"mass": [1.5] * N}))
    backwards = rest().flip(0).tolist()
    with pytest.raises(checks.FieldError, match="order of the reference"):
        frames.trajectory(at_rest("id xu", values={"xu": backwards}))
    with pytest.raises(checks.FieldError, match="frame 1: box must keep its length"):
        read_frames(file(dump(chain, path, "id mass x vx"))).trajectory(at_rest("id x", side=11.0))


def test_walls_made_of_particles_are_left_out(motion, file):
    """A fixed chain between two frozen particles."""
    chain, path = motion
    frames = read_frames(file(dump(chain, path, box="ff ff ff")))
    inner = frames.select(range(2, N))
    assert inner.ids.tolist() == list(range(2, N))
    assert torch.equal(inner.chain("fixed").masses, chain.masses[1:-1])
    assert torch.equal(inner.trajectory().velocity, path.velocity[:, 1:-1])
    assert torch.equal(inner[2:4].times, path.times[2:4])
    with pytest.warns(FramesWarning, match="not marked periodic along x"):
        frames.chain("periodic")
    with pytest.raises(checks.FieldError, match="ids must be in"):
        frames.select([1, 99])
    for ids in ([], [1.5], "word", [True]):
        with pytest.raises((checks.FieldTypeError, TypeError, ValueError)):
            frames.select(ids)


# Masses and units


def test_masses_from_elsewhere(motion, file):
    chain, path = motion
    written = file(dump(chain, path, "id type xu vx", values={"type": [1 + i % 2 for i in range(N)]}))
    with pytest.raises(
        checks.FieldError, match=r"masses must be in the file .* or be given by masses= or, with radii, density="
    ):
        read_frames(written).chain()
    assert torch.equal(read_frames(written, masses=chain.masses).chain().masses, chain.masses)
    assert read_frames(written, masses={1: 0.5, 2: 1.5}).masses.tolist() == [0.5, 1.5] * (N // 2)
    with pytest.raises(checks.FieldError, match="masses must hold the type 2"):
        read_frames(written, masses={1: 0.5})
    with pytest.raises(checks.FieldError, match="radius must be in the file"):
        read_frames(written, density=2.0)
    spheres = read_frames(file(dump(chain, path, "id radius xu vx")), density=2.0)
    assert (spheres.masses - 2 * 4 / 3 * math.pi * 0.55**3).abs().max() < 1e-14
    disks = read_frames(file(dump(chain, path, "id radius xu vx y vy")), density=2.0)
    assert (disks.masses - 2 * math.pi * 0.55**2).abs().max() < 1e-14


def test_si_units_come_back(motion, file, at_rest):
    """A run written in SI units is that of the library again."""
    chain, path = motion
    beads = tc.Scaling(radius=0.01, density=7800.0, young_modulus=2e11, poisson_ratio=0.3, force=10.0)
    length, time, mass = (beads.unit(quantity) for quantity in ("length", "time", "mass"))
    text = "".join(dump(chain, path))
    rows = []
    for line in text.splitlines():
        words = line.split()
        if len(words) == 4 and words[0].isdigit():
            m, x, v = (float(word) for word in words[1:])
            line = f"{words[0]} {m * mass:.17g} {x * length:.17g} {v * length / time:.17g}"
        elif rows and rows[-1] == "ITEM: TIME":
            line = f"{float(line) * time:.17g}"
        elif words == ["0", "10.0"]:
            line = f"0 {10 * length:.17g}"
        rows.append(line)
    frames = read_frames(file("\n".join(rows) + "\n"))
    with pytest.warns(FramesWarning, match="masses: their mean is"):
        frames.chain()
    scaled = frames.scaled(beads)
    assert (scaled.chain().masses - chain.masses).abs().max() < 1e-12
    found = scaled.trajectory()
    assert (found.times - path.times).abs().max() < 1e-12 * TIMES
    assert (found.displacement - (path.displacement - path.displacement[0])).abs().max() < 1e-12 * SIDE
    assert (found.velocity - path.velocity).abs().max() < 1e-12
    assert abs(float(scaled.box.lengths[0]) - SIDE) < 1e-12 * SIDE
    for units, words in ((3.0, "units must be"), (beads, "be given once")):
        with pytest.raises((checks.FieldError, checks.FieldTypeError), match=words):
            scaled.scaled(units)


# Contacts


def local(pairs, columns="index c_1[1] c_1[2] c_2[1] c_2[2]", times=TIMES, values="1.0 0.7"):
    rows = "".join(f"{i + 1} {a} {b} {values}\n" for i, (a, b) in enumerate(pairs))
    return [
        f"ITEM: TIMESTEP\n{100 * k}\nITEM: NUMBER OF ENTRIES\n{len(pairs)}\nITEM: BOX BOUNDS pp ff ff\n0 10\n-1 1\n-1 1\nITEM: ENTRIES {columns}\n{rows}" for k in range(times)
    ]  # fmt: skip


RING = [(i, i % N + 1) for i in range(1, N + 1)]


def test_contact_lists_of_lammps(motion, file):
    chain, path = motion
    written, contacts = file(dump(chain, path, "id mass radius xu vx")), file(local(RING))
    frames = read_frames(written, contacts=contacts)
    assert frames.contacts.pairs.tolist() == [[a - 1, b - 1] for a, b in RING]
    assert frames.contacts.overlap is None
    named = file([part.replace("ENTRIES", "PAIRS") for part in local(RING)])  # dump_modify ... label PAIRS
    assert torch.equal(read_frames(written, contacts=named).contacts.pairs, frames.contacts.pairs)
    columns = {"id1": "c_1[1]", "id2": "c_1[2]", "distance": "c_2[1]", "normal_force": "c_2[2]"}
    frames = read_frames(written, contacts=contacts, contact_columns=columns)
    assert (frames.contacts.overlap - 0.1).abs().max() < 1e-14
    for law, factor in (("linear", 1.0), ("hertz", 1.5)):
        assert (frames.chain(stiffness=law).stiffness - factor * 7).abs().max() < 1e-12
        units = frames.fit_units(law)
        assert math.isclose(units.stiffness, factor * 7, rel_tol=1e-12)
        assert math.isclose(units.length, 0.1, rel_tol=1e-12)
        assert math.isclose(units.mass, 1.0, rel_tol=1e-12)
        again = frames.scaled(units)
        assert (again.chain(stiffness=law).stiffness - 1).abs().max() < 1e-12
        assert math.isclose(float(again.times[1]), math.sqrt(factor * 7), rel_tol=1e-12)
    with pytest.raises(checks.FieldError, match="law must be one of"):
        frames.fit_units("elastic")
    with pytest.raises(checks.FieldError, match="stiffness must be a number"):
        frames.chain(stiffness="elastic")
    with pytest.raises(checks.FieldError, match="contacts must be read with the frames"):
        read_frames(written).chain(stiffness="hertz")


def test_contacts_that_are_not_those_of_the_chain(motion, file):
    chain, path = motion
    written = file(dump(chain, path))
    crossed = [(1, 3) if pair == (2, 3) else pair for pair in RING]
    frames = read_frames(written, contacts=file(local(crossed)))
    for ask in (frames.chain, frames.trajectory):
        with pytest.raises(
            checks.FieldError, match="contacts must join neighbors along x for a chain, got one of ids 1 and 3"
        ):
            ask()
    columns = {"id1": "c_1[1]", "id2": "c_1[2]", "overlap": "c_2[1]", "normal_force": "c_2[2]"}
    frames = read_frames(written, contacts=file(local(RING[:-1])), contact_columns=columns)
    with pytest.raises(
        checks.FieldError, match="contacts must be 10, one between any two neighbors, got none at contact 1"
    ):
        frames.chain(stiffness="hertz")
    frames = read_frames(written, contacts=file(local(RING, values="0.0 0.7")), contact_columns=columns)
    with pytest.raises(checks.FieldError, match="overlap must be positive"):
        frames.chain(stiffness="hertz")


def test_contacts_with_walls_that_are_particles(motion, file):
    """Left out, they are walls: N - 2 particles have N - 1 contacts."""
    chain, path = motion
    columns = {"id1": "c_1[1]", "id2": "c_1[2]", "overlap": "c_2[1]", "normal_force": "c_2[2]"}
    text = local(RING[:-1], values="{} 0.5")
    text = [
        "\n".join(line.format(0.1 * int(line.split()[0])) if "{}" in line else line for line in part.split("\n"))
        for part in text
    ]
    frames = read_frames(file(dump(chain, path, box="ff ff ff")), contacts=file(text), contact_columns=columns)
    fixed = frames.select(range(2, N)).chain("fixed", "linear")
    assert fixed.n_contacts == N - 1
    assert (fixed.stiffness - 5 / torch.arange(1, N, dtype=torch.float64)).abs().max() < 1e-12


def test_contacts_of_some_frames(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(chain, path)), contacts=file([*local(RING)[::2], *local([], times=TIMES)[5:]]))
    assert [None if frame.contacts is None else len(frame.contacts.pairs) for frame in frames] == [
        N,
        None,
        N,
        None,
        N,
        0,
    ]
    with pytest.raises(checks.FieldError, match="step must be that of a frame"):
        read_frames(file(dump(chain, path)[1:2]), contacts=file(local(RING)[2:3]))


GRANULAR = "pos id force force_normal history delta"
WIDE = " ".join(f"c_cpl[{i}]" for i in range(1, 6 + 3 + 3 + 3 + 2 + 1 + 1))


def test_contact_lists_of_liggghts(motion, file):
    """The columns of compute pair/gran/local: positions, ids and flag, forces, history, overlap."""
    chain, path = motion
    rows = "".join(
        f"{a - 0.5} 0.1 0 {b - 0.5} 0.1 0 {a} {b} {int(a > b)} 3.5 4.5 9 0 3 4 0.1 0.2 0.05\n" for a, b in RING
    )
    text = [
        f"ITEM: TIMESTEP\n{100 * k}\nITEM: LABEL\nx\nITEM: NUMBER OF ENTRIES\n{N}\nITEM: BOX BOUNDS pp ff ff\n0 10\n-1 1\n-1 1\nITEM: ENTRIES {WIDE} \n{rows}" for k in range(TIMES)
    ]  # fmt: skip
    written, contacts = file(dump(chain, path)), file(text)
    frames = read_frames(written, contacts=contacts)
    assert frames.contacts.pairs.tolist() == [[a - 1, b - 1] for a, b in RING]
    frames = read_frames(written, contacts=contacts, contact_columns=GRANULAR)
    assert (frames.contacts.overlap - 0.05).abs().max() < 1e-15
    assert (frames.contacts.normal_force - 5).abs().max() < 1e-14
    assert (frames.chain(stiffness="hertz").stiffness - 150).abs().max() < 1e-11
    with pytest.raises(checks.FieldError, match="columns must be 24 for"):
        read_frames(written, contacts=contacts, contact_columns="pos vel id force force_normal torque").contacts  # noqa: B018


# MercuryDPM, in the layout that it writes: header, position, velocity, radius, angles, angular velocity, one number more


def mercury(chain, path, flat=False):
    data, fstat = [], []
    for k, t in enumerate(path.times.tolist()):
        head = f"{N} {t} 0 -1 {SIDE} 1 \n" if flat else f"{N} {t} 0 -1 -1 {SIDE} 1 1 \n"
        x, v = rest() + path.displacement[k], path.velocity[k]
        rows = (
            f"{x[i]:.17g} 0.25 {v[i]:.17g} 0 0.55 0 0 0\n"
            if flat
            else f"{x[i]:.17g} 0.25 0 {v[i]:.17g} 0 0 0.55 0 0 0 0 0 0 0\n"
            for i in range(N)
        )
        data.append(head + "".join(rows))
        sides = []
        for a in range(N - 1):
            overlap = 1.1 - float(x[a + 1] - x[a])
            for one, two, sign in ((a, a + 1, -1), (a + 1, a, 1)):
                sides.append(f"0 {one} {two} {x[a] + 0.5} 0 0 {overlap:.17g} 0 {2 * overlap:.17g} 0 {sign} 0 0 0 0 0\n")
        sides += ["0 0 -1 0 0 0 0.05 0 0.1 0 -1 0 0 0 0 0\n", f"0 {N - 1} -2 {SIDE} 0 0 0.05 0 0.1 0 1 0 0 0 0 0\n"]
        fstat.append(f"# {t} 1\n# 0 -1 -1 {SIDE} 1 1\n# 0.55 0.55 0 0 0 0\n" + "".join(sides))
    restart = f"MercuryDPM 1.0 name run\nxMin 0 xMax {SIDE}\nSpecies 1\nParticles {N}\n" + "".join(
        f"BaseParticle id {i} indSpecies 0 position {i} 0 0 radius 0.55 invMass {1 / chain.masses[i]:.17g} timeStamp 0\n"
        for i in range(N)
    )
    return data, fstat, restart


@pytest.mark.parametrize("flat", [False, True])
def test_mercury_files(flat, motion, file):
    chain, path = motion
    data, fstat, restart = mercury(chain, path, flat)
    written = file(data, "run.data")
    with pytest.raises(checks.FieldError, match=r"masses must be in the file .*\.restart"):
        read_frames(written).chain("fixed")
    file(restart, "run.restart")
    frames = read_frames(written, contacts=file(fstat, "run.fstat"))
    assert frames.ids.tolist() == list(range(N))
    assert frames.box.upper[:2] == (SIDE, 1.0)
    assert len(frames.contacts.pairs) == N + 1
    fixed = frames.chain("fixed", "linear", axis="x")
    assert (fixed.masses - chain.masses).abs().max() < 1e-14
    assert (fixed.stiffness - 2).abs().max() < 1e-12
    found = frames.trajectory()
    assert torch.equal(found.times, path.times)
    assert (found.displacement - (path.displacement - path.displacement[0])).abs().max() < 1e-14 * SIDE
    assert torch.equal(found.velocity, path.velocity)
    dense = read_frames(file(data, "other.data"), density=3.0)
    assert math.isclose(
        float(dense.masses[0]), 3 * (math.pi * 0.55**2 if flat else 4 / 3 * math.pi * 0.55**3), rel_tol=1e-14
    )


def test_mercury_wraps_where_the_user_says(motion, file):
    chain, path = motion
    moving = replace(path, displacement=path.displacement + torch.arange(TIMES, dtype=torch.float64)[:, None] * 4)
    data, _, restart = mercury(chain, moving)
    wrapped = []
    for part in data:
        head, *rows = part.splitlines()
        wrapped.append(
            "\n".join([head, *(f"{float(row.split()[0]) % SIDE:.17g} {row.split(' ', 1)[1]}" for row in rows)]) + "\n"
        )
    written = file(wrapped, "run.data")
    file(restart, "run.restart")
    found = read_frames(written, periodic="x").trajectory()
    assert (found.displacement - (moving.displacement - moving.displacement[0])).abs().max() < 1e-12
    with pytest.raises(
        checks.FieldError, match="(side of a box that is not marked periodic|keep the order of the chain)"
    ):
        read_frames(written).trajectory()


def test_fixed_particles_of_mercury_have_no_mass(motion, file):
    chain, path = motion
    data, _, restart = mercury(chain, path)
    file(restart.replace(restart.split("invMass ")[1].split()[0], "0", 1), "run.restart")
    frames = read_frames(file(data, "run.data"))
    with pytest.raises(checks.FieldError, match="masses must be finite .* got a fixed particle, id 0"):
        frames.chain("fixed")
    assert frames.select(range(1, N)).chain("fixed").n_particles == N - 1


# Extended XYZ by ASE, netCDF by this library


def test_extended_xyz_as_ase_writes_it(motion, tmp_path):
    ase = pytest.importorskip("ase", reason="needs the extra xyz")
    io = importlib.import_module("ase.io")
    chain, path = motion
    images = []
    for k in range(TIMES):
        positions = np.zeros((N, 3))
        positions[:, 0] = rest() + path.displacement[k]
        atoms = ase.Atoms(
            "H" * N, positions, cell=[SIDE, 2, 2], pbc=[True, False, False], info={"Time": float(path.times[k])}
        )
        atoms.arrays["velo"] = np.stack([path.velocity[k].numpy(), np.zeros(N), np.zeros(N)], -1)
        atoms.arrays["mass"] = chain.masses.numpy()
        images.append(atoms)
    written = tmp_path / "run.xyz"
    io.write(written, images, format="extxyz")
    frames = read_frames(written)
    found = frames.trajectory()
    assert torch.equal(found.times, path.times)
    assert (
        found.displacement - (path.displacement - path.displacement[0])
    ).abs().max() < 2e-8  # ase writes eight decimals
    assert (frames.chain().masses - chain.masses).abs().max() < 1e-8


def test_conversion_keeps_everything(motion, file, tmp_path):
    chain, path = motion
    data, fstat, restart = mercury(chain, path)
    file(restart, "run.restart")
    sources = {
        "lammps": (file(dump(chain, path, "id mass x ix vx radius", shift=-0.52, seed=2)), file(local(RING)), {}),
        "mercury": (file(data, "run.data"), file(fstat, "run.fstat"), {"periodic": "x"}),
        "plain": (file(dump(chain, path, "id xs", time=False)), None, {}),
    }
    for name, (source, contacts, options) in sources.items():
        before = read_frames(source, contacts=contacts, **options)
        out = convert(source, tmp_path / f"{name}.nc", contacts=contacts, **options)
        after = read_frames(out)
        assert len(after) == len(before)
        for a, b in zip(before, after, strict=True):
            assert (a.step, a.time, a.axes, a.unwrapped, a.box, a.number) == (
                b.step,
                b.time,
                b.axes,
                b.unwrapped,
                b.box,
                b.number,
            )
            for field in ("ids", "positions", "velocities", "masses", "radii"):
                one, two = getattr(a, field), getattr(b, field)
                assert (one is None and two is None) or torch.equal(one, two), field
            assert (a.contacts is None) == (b.contacts is None)
            if a.contacts is not None:
                assert torch.equal(a.contacts.pairs, b.contacts.pairs)
                for field in ("overlap", "normal_force"):
                    one, two = getattr(a.contacts, field), getattr(b.contacts, field)
                    assert (one is None and two is None) or torch.equal(one, two), field
        with xarray.open_dataset(out, engine="h5netcdf") as labeled:
            assert labeled.sizes["particle"] == N
            assert all("long_name" in variable.attrs for variable in labeled.variables.values())
        assert torch.equal(after[2:4].positions, before[2:4].positions)
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


# What is doubtful


def warned(match, call):
    with pytest.warns(FramesWarning, match=match) as caught:
        found = call()
    assert all("\n" not in str(one.message) for one in caught)
    assert caught[0].filename == __file__
    return found


@pytest.mark.parametrize("name", ["cut.dump", "cut.dump.gz"])
def test_a_last_frame_that_is_cut_short_is_left_out(name, motion, file, tmp_path):
    chain, path = motion
    text = dump(chain, path)
    whole = "".join(text)
    for lost in (1, 30, len(text[-1]) - 20):
        cut = file(whole[:-lost], name)
        frames = warned(
            f"{name}, frame 6: the file ends after . of its rows: left out", lambda cut=cut: read_frames(cut)
        )
        assert len(frames) == TIMES - 1
    broken = tmp_path / "broken.dump.gz"
    broken.write_bytes(gzip.compress(whole.encode())[:-40])
    frames = warned("broken.dump.gz, frame .: the file ends", lambda: read_frames(broken))
    assert torch.equal(frames.trajectory().velocity, path.velocity[: len(frames)])


def test_a_mean_mass_far_from_one(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(tc.Chain(chain.masses * 3), path)))
    assert torch.equal(warned("frame 1: masses: their mean is 3, not 1", frames.chain).masses, chain.masses * 3)


def test_energy_that_drifts(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(chain, path)))
    still = file(dump(chain, tc.Trajectory(path.times[:1], 0 * path.displacement[:1], 0 * path.velocity[:1])))
    frames.trajectory(still, chain=chain)
    slower = torch.exp(-0.05 * path.times)[:, None]
    damped = replace(path, displacement=path.displacement * slower, velocity=path.velocity * slower)
    found = read_frames(file(dump(chain, damped), "damped.dump"))
    warned("damped.dump, frame 6: energy: 0.6065 of that of frame 1", lambda: found.trajectory(still, chain=chain))
    found.trajectory(still, chain=replace(chain, damping=0.1))
    with pytest.raises(checks.FieldError, match="chain must have masses of shape"):
        found.trajectory(still, chain=tc.Chain(chain.masses[1:]))
    warned("energy: .* another stiffness", lambda: check_energy("run", replace(chain, stiffness=2.0), path))
    later = torch.where(path.times > 0, 1.0, 0.5)[:, None]  # a kick after the first frame
    kicked = replace(path, displacement=path.displacement * later, velocity=path.velocity * later)
    with pytest.raises(checks.FieldError, match=r"run, frame \d: energy must be that of the first frame, got .* units"):
        check_energy("run", chain, kicked)


def test_displacements_above_the_overlap(motion, file, at_rest):
    chain, path = motion
    large = replace(path, displacement=path.displacement * 5)
    frames = read_frames(file(dump(chain, large, "id mass radius xu vx"), "large.dump"))
    still = at_rest("id radius xu vx")
    warned(
        "large.dump, frame .: x: displacements above the overlap: the contact of ids", lambda: frames.trajectory(still)
    )
    units = ContactUnits(mass=1.0, stiffness=1.0, length=0.1)
    chain = frames.scaled(units).chain()
    scaled = warned("displacements above the overlap", lambda: frames.scaled(units).trajectory(still))
    warned(
        "run, frame .: displacement: above the overlap",
        lambda: check_opening("run", chain, scaled),
    )
    apart = file(dump(chain, path, "id mass radius xu vx", values={"radius": [0.4] * N}), "apart.dump")
    warned("do not touch in the reference", lambda: read_frames(apart).trajectory())


def test_neighbors_that_pass_each_other(motion, file):
    chain, path = motion
    displacement = path.displacement.clone()
    displacement[4, 5] += 1.2
    frames = read_frames(file(dump(chain, replace(path, displacement=displacement)), "crossed.dump"))
    with pytest.raises(
        checks.FieldError, match="crossed.dump, frame 5: x must keep the order of the chain, got ids 6 and 7"
    ):
        frames.trajectory()
    with pytest.raises(checks.FieldError, match="frame 5: x must keep the order"):
        frames[::2].trajectory()
    displacement[0, 5] = displacement[0, 6] + 1
    with pytest.raises(checks.FieldError, match="x must differ from particle to particle"):
        read_frames(file(dump(chain, replace(path, displacement=displacement)))).chain()


@pytest.mark.parametrize("columns", ["id mass xu vx", "id mass xs vx", "id mass x ix vx"])
def test_positions_of_too_few_digits(columns, file):
    """What LAMMPS writes unless told otherwise: six digits."""
    chain, path = made(amplitude=1e-4)
    frames = read_frames(file(dump(chain, path, columns, form=".6g"), "coarse.dump"))
    warned("coarse.dump, frame 6: x: positions of . digits", frames.trajectory)
    read_frames(file(dump(chain, path, columns))).trajectory()
    units = ContactUnits(mass=1.0, stiffness=1.0, length=0.3)
    warned("coarse.dump, frame 6: x: positions of . digits", frames.scaled(units).trajectory)


def test_a_box_of_six_digits_that_is_crossed(file):
    """As LIGGGHTS writes its bounds; a box of few digits is a round number, one of many is not rounded."""
    chain, path = made(amplitude=1e-4)
    own = path.displacement[:, 3]
    for side, doubtful in ((10.0, False), (10.1234, True), (10.123412345, False)):
        shift = side - 3.5 - float(own.min() + own.max()) / 2  # the fourth particle goes to and fro across the bound
        frames = read_frames(file(dump(chain, path, "id mass x vx", shift=shift, side=side), "crossed.dump"))
        if doubtful:
            found = warned("crossed.dump, frame 6: box: the bound 10.1234 along x has six digits", frames.trajectory)
        else:
            found = frames.trajectory()
        assert (found.displacement - (path.displacement - path.displacement[0])).abs().max() < 1e-13 * SIDE


def test_motion_across_the_chain(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(chain, path, "id mass xu y vx vy", values={"vy": [0.01] * N})))
    found = warned("velocities: .* of the squares are across the chain's axis x", frames.trajectory)
    assert torch.equal(found.velocity, path.velocity)


def test_no_velocities(motion, file):
    chain, path = motion
    frames = read_frames(file(dump(chain, path, "id mass xu")))
    assert frames[0].velocities is None
    for ask in (lambda: frames.velocities, frames.trajectory):
        with pytest.raises(checks.FieldError, match="frame 1: velocities must be in the file"):
            ask()


# The manual and the registry


def test_the_manual_runs():
    module = importlib.import_module("torchchain.frames.files")
    done = doctest.testmod(module, extraglobs={"tc": tc})
    assert done.attempted >= 8
    assert done.failed == 0


def test_a_format_states_itself():
    for name, entry in FORMATS.items():
        assert entry.name == name
        assert entry.holds in ("particles", "contacts")
        assert entry.match in ("step", "time")
        assert len(entry.summary) > 20
    other = [Path(path).read_bytes()[:4096] for path in (tc.__file__, __file__)]
    assert not any(entry.recognizes(head) for head in other for entry in FORMATS.values())
