"""Packings of other codes: contacts from overlaps or contact lists, their motion, and the transfer between shells of wavenumber."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import cli
from torchchain import network as nw
from torchchain.checks import FieldError
from torchchain.cli import outputs
from torchchain.frames import FramesWarning

DATA = Path(__file__).parent / "data" / "packing_lammps.npz"
F64 = torch.float64
pytestmark = pytest.mark.filterwarnings("ignore::torchchain.network.modes.FloppyWarning")
TIMES = torch.linspace(0, 6, 7, dtype=F64)


@pytest.fixture(scope="module")
def grains():
    """A jammed packing of 48 disks by LAMMPS, masses of its own."""
    with np.load(DATA) as file:
        x, radii, box = (torch.from_numpy(file[name]) for name in ("positions", "radii", "box"))
    masses = tc.Disorder(strength=0.2).masses(len(radii), 1, seed=1)[0]
    return nw.packing(x % box, radii, masses, box)


def head(k, time, count, kind, box, walls="pp pp pp"):
    bounds = "".join(f"0 {side!r}\n" for side in box.tolist()) + ("-1 1\n" if len(box) == 2 else "")
    return f"ITEM: TIME\n{time!r}\nITEM: TIMESTEP\n{k}\nITEM: NUMBER OF {kind}\n{count}\nITEM: BOX BOUNDS {walls}\n{bounds}"


def dump(packing, path, columns="id mass radius x y vx vy"):
    """A LAMMPS dump of a motion, positions wrapped into the box."""
    text = ""
    for k, time in enumerate(path.times.tolist()):
        x = (packing.positions + path.displacement[k]) % packing.box
        known = {"id": range(1, packing.n_particles + 1), "mass": packing.masses, "radius": packing.radii}
        known |= {axis: x[:, i] for i, axis in enumerate("xyz"[: packing.dimension])}
        known |= {f"v{axis}": path.velocity[k][:, i] for i, axis in enumerate("xyz"[: packing.dimension])}
        rows = zip(*(known[name] for name in columns.split()), strict=True)
        lines = [
            " ".join(
                str(int(v)) if name == "id" else repr(float(v)) for name, v in zip(columns.split(), row, strict=True)
            )
            for row in rows
        ]
        text += head(k, time, len(lines), "ATOMS", packing.box) + f"ITEM: ATOMS {columns}\n" + "\n".join(lines) + "\n"
    return text  # fmt: skip


def listed(packing, displacement, columns="id1 id2 overlap normal_force", law="linear"):
    """A contact list of one frame: overlaps and forces of the grains at their places."""
    length = (packing.bond_vectors + packing.elongation(displacement)).square().sum(-1).sqrt()
    overlap = packing.radii[packing.bonds].sum(-1) - length
    force = overlap if law == "linear" else 2 / 3 * overlap.clamp(min=0) ** 1.5
    rows = zip((packing.bonds + 1).tolist(), overlap.tolist(), force.tolist(), strict=True)
    lines = [f"{a} {b} {o!r} {f!r}" for (a, b), o, f in rows]
    return head(0, 0.0, len(lines), "ENTRIES", packing.box) + f"ITEM: ENTRIES {columns}\n" + "\n".join(lines) + "\n"


def starts(packing, amplitude=1e-6):
    """Two waves that fit the box, both polarizations of each, and three kicks, (run, particle, component)."""
    fitting = nw.box_wavevectors(packing, 1.6)[1:]
    made = []
    for q in (fitting[0], fitting[2], fitting[-1]):
        across = torch.stack([-q[1], q[0]])
        made += [(packing.positions @ q).cos()[:, None] * e / e.norm() for e in (q, across)]
    kicks = torch.zeros(3, packing.n_particles, 2, dtype=F64)
    for i in range(3):
        kicks[i, 7 * i + 3, i % 2] = 1.0
    waves = torch.stack(made)
    return tc.State(
        amplitude * torch.cat([waves, torch.zeros_like(kicks)]), amplitude * torch.cat([torch.zeros_like(waves), kicks])
    )


def at_rest(packing):
    still = torch.zeros(1, packing.n_particles, 2, dtype=F64)
    return nw.NetworkTrajectory(TIMES[:1], still, still)


@pytest.fixture(scope="module")
def moved(grains):
    return nw.evolve(grains, starts(grains), TIMES)


def single(path, i):
    return nw.NetworkTrajectory(path.times, path.displacement[i], path.velocity[i])


def same(a, b):
    order = [n.bonds.min(-1).values * n.n_particles + n.bonds.max(-1).values for n in (a, b)]
    assert torch.equal(order[0].sort().values, order[1].sort().values)
    torch.testing.assert_close(a.stiffness_matrix(), b.stiffness_matrix(), rtol=0, atol=1e-12)


# Bands


def test_bands_of_a_packing_add_up_to_its_energy(grains, moved):
    bands = nw.packing_bands(grains, 2)
    assert bands.labels == ("longitudinal 1", "longitudinal 2", "transverse 1", "transverse 2", "other")
    energy = nw.packing_band_energy(grains, moved, bands, normalize=False)
    torch.testing.assert_close(energy.sum(-1), nw.total_energy(grains, moved), rtol=1e-9, atol=0)
    shares = nw.packing_band_energy(grains, moved, bands)
    # A plane wave is in its own shell and polarization, up to what the irregular places mix.
    assert shares[:2, 0].argmax(-1).tolist() == [0, 2]
    assert shares[4:6, 0].argmax(-1).tolist() == [1, 3]
    waves = nw.plane_wave_energy(grains, moved, bands.largest)
    low = (waves.lengths > 0) & (waves.lengths <= bands.largest / 2)
    torch.testing.assert_close(energy[..., [0, 2]], waves.energy[..., low, :].sum(-2), rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"n_shells": 9}, "n_shells must leave a wavevector of the box in every shell, got 9, with none in shell 1"),
        ({"n_shells": 0}, "n_shells must be at least 1"),
        ({"largest": -1.0}, "largest wavenumber must be greater than 0"),
    ],
)
def test_bands_that_cannot_be(grains, settings, words):
    with pytest.raises(FieldError, match=words):
        nw.packing_bands(grains, **settings)


def test_a_box_with_walls_has_no_bands(grains):
    open_box = replace(
        grains,
        box=torch.tensor([float(grains.box[0]), torch.inf], dtype=F64),
        images=None,
        bonds=grains.bonds[:1],
        stiffness=1.0,
        tension=0.0,
        damping=0.0,
    )
    with pytest.raises(FieldError, match="box must be periodic along every direction"):
        nw.packing_bands(open_box)  # fmt: skip


# Contacts


@pytest.mark.parametrize("law", ["linear", "hertz"])
def test_contacts_of_a_list_are_those_of_overlaps(grains, tmp_path, law):
    """At rest, and of a frame in motion as the law takes them back to the reference."""
    if law == "hertz":  # other prestress, the same grains
        grains = nw.packing(grains.positions, grains.radii, grains.masses, grains.box, contact="hertz")
    shape = (grains.n_particles, 2)
    push = 1e-4 * torch.randn(shape, dtype=F64, generator=torch.Generator().manual_seed(0))
    first = nw.NetworkTrajectory(TIMES[:1], push[None], torch.zeros(1, *shape, dtype=F64))
    for name, path in (("run.dump", first), ("rest.dump", at_rest(grains))):
        (tmp_path / name).write_text(dump(grains, path))
    (tmp_path / "run.local").write_text(listed(grains, push, law=law))
    frames = tc.read_frames(tmp_path / "run.dump", contacts=tmp_path / "run.local")
    made = frames.network(tmp_path / "rest.dump", contact=law)
    assert isinstance(made, nw.Packing)
    same(made, grains)
    theirs = frames.network(tmp_path / "rest.dump", stiffness=law)
    assert not isinstance(theirs, nw.Packing)
    same(theirs, grains)
    same(tc.read_frames(tmp_path / "run.dump").network(tmp_path / "rest.dump", contact=law), grains)
    # Without radii, and without prestress.
    (tmp_path / "bare.dump").write_text(dump(grains, at_rest(grains), "id mass x y vx vy"))
    bare = tc.read_frames(tmp_path / "bare.dump", contacts=tmp_path / "run.local").network(
        stiffness="linear", prestress=False
    )
    assert not bare.is_prestressed
    assert bare.n_bonds == grains.n_contacts


def test_walls_are_left_out_with_a_word(tmp_path):
    """MercuryDPM: three spheres, two contacts, and one of each sphere with the floor."""
    frame = "3 {0} 0 0 0 4 4 4 \n" + "".join(f"{0.9 * i + 1} 1 0.45 0 0 0 0.5 0 0 0 0 0 0 0\n" for i in range(3))
    row = "0 {a} {b} 1 0 0 {d} 0 {f} 0 1 0 0 0 0 0\n"
    rows = row.format(a=0, b=1, d=0.1, f=0.2) + row.format(a=1, b=0, d=0.1, f=0.2) + row.format(a=1, b=2, d=0.1, f=0.2)
    rows += "".join(row.format(a=i, b=-1, d=0.05, f=0.1) for i in range(3))
    (tmp_path / "a.data").write_text(frame.format(0))
    (tmp_path / "a.fstat").write_text("# 0 1\n# 0 0 0 4 4 4\n# 0.5 0.5 0 0 0 0\n" + rows)
    frames = tc.read_frames(tmp_path / "a.data", contacts=tmp_path / "a.fstat", density=1.0)
    with pytest.warns(FramesWarning, match=r"a.data, frame 1: contacts: 3 with walls are left out"):
        made = frames.network(stiffness="linear")
    assert made.bonds.tolist() == [[0, 1], [1, 2]]
    assert made.bond_stiffness.tolist() == [2.0, 2.0]
    torch.testing.assert_close(made.bond_tension, torch.full((2,), -0.2, dtype=F64))


LIST = "ITEM: ENTRIES id1 id2 overlap normal_force\n"
BAD_LISTS = [
    ("1 2 0.1 0.1\n2 1 0.1 0.1\n", {}, "frame 1: bonds must differ from each other"),
    ("1 2 0.1 0.1\n1 2 0.1 0.1\n", {"stiffness": "linear"}, "frame 1: bonds must differ from each other"),
    ("1 1 0.1 0.1\n", {}, "contacts must join two particles, got id 1 with itself"),
    ("1 99 0.1 0.1\n", {}, "id2 must be that of a particle"),
    ("1 2.5 0.1 0.1\n", {}, "id2 must be whole numbers"),
    ("1 2 nan 0.1\n", {}, "overlap must be a finite number"),
    ("1 2 0.1\n", {}, "row 1 must hold 4 columns"),
    ("1 2 0.1 -0.1\n", {"stiffness": "hertz"}, "normal_force must be positive at every contact"),
    ("1 2 0.1 0.0\n", {"stiffness": "linear"}, "normal_force must be positive at every contact"),
    ("1 2 0.1 0.1\n", {"stiffness": "steel"}, "stiffness must be one of linear, hertz"),
    ("1 2 0.1 0.1\n", {"stiffness": -1.0}, "stiffness must be greater than 0"),
    ("1 2 0.1 0.1\n", {"contact": "glue"}, "contact must be one of linear, hertz"),
    ("", {}, "contacts must be at least one between two particles"),
    ("1 3 0.1 0.1\n", {}, "length of bonds must be less than half the box"),
]  # fmt: skip


@pytest.mark.parametrize(("rows", "settings", "words"), BAD_LISTS)
def test_bad_contact_lists_are_one_line(rows, settings, words, tmp_path):
    box = torch.tensor([3.0, 3.0], dtype=F64)
    body = "1 1.0 0.5 0.5\n2 1.0 1.4 0.5\n3 1.0 2.0 2.0\n"
    (tmp_path / "a.dump").write_text(head(0, 0.0, 3, "ATOMS", box) + "ITEM: ATOMS id mass xu yu\n" + body)
    (tmp_path / "a.local").write_text(head(0, 0.0, rows.count("\n"), "ENTRIES", box) + LIST + rows)
    with pytest.raises(FieldError, match=words) as caught:
        tc.read_frames(tmp_path / "a.dump", contacts=tmp_path / "a.local").network(**settings)
    assert "\n" not in str(caught.value)


def test_open_contacts_are_left_out_with_a_word(grains, tmp_path):
    (tmp_path / "a.dump").write_text(dump(grains, at_rest(grains)))
    (tmp_path / "a.local").write_text(
        listed(grains, at_rest(grains).displacement[0])
        .replace("NUMBER OF ENTRIES\n", "NUMBER OF ENTRIES\n1")
        .replace(f"1{grains.n_contacts}\n", f"{grains.n_contacts + 1}\n")
        + "1 2 -0.5 0\n"
    )
    frames = tc.read_frames(tmp_path / "a.dump", contacts=tmp_path / "a.local")
    with pytest.warns(FramesWarning, match=f"contacts: 1 of {grains.n_contacts + 1} are open and left out"):
        same(frames.network(), grains)  # fmt: skip


# Transfers


def test_trajectories_of_packings_give_a_transfer(grains, moved):
    other = nw.packing(grains.positions, grains.radii, tc.Disorder(strength=0.2).masses(48, 1, seed=2)[0], grains.box)
    networks, paths, energies = [], [], []
    bands = nw.packing_bands(grains, 2)
    for each, path in ((grains, moved), (other, nw.evolve(other, starts(other), TIMES))):
        networks += [each] * 9
        paths += [single(path, i) for i in range(9)]
        energies.append(nw.packing_band_energy(each, path, bands))
    found = tc.BandTransfer.from_trajectories(networks, paths, 5, provenance="disks")
    shares = torch.stack(energies)
    expected = tc.BandTransfer.from_energies(TIMES, shares, starts=shares[:, :, 0])
    assert found.n_bands == 5
    assert found.block_counts == (1, 1)
    torch.testing.assert_close(found.mean, expected.mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(found.mean.sum(-1), torch.ones(5, 7, dtype=F64), rtol=0, atol=1e-9)
    torch.testing.assert_close(found.mean[:, 0], torch.eye(5, dtype=F64), rtol=0, atol=1e-9)
    assert 1 < found.attributes["start_condition"] < 100
    with pytest.raises(FieldError, match="run 1: n_bands must be 2 times the shells of .q. and 1"):
        tc.BandTransfer.from_trajectories(networks, paths, 4)
    with pytest.raises(FieldError, match="run 1: chains must be a network"):
        tc.BandTransfer.from_trajectories([tc.Chain(torch.ones(48, dtype=F64))], paths[:1], 5)
    slow = nw.NetworkTrajectory(TIMES, moved.displacement[0] * (1 - 0.05 * TIMES)[:, None, None], moved.velocity[0])
    with pytest.warns(FramesWarning, match=r"run 1, frame \d: energy: .* for a network without damping"):
        tc.BandTransfer.from_trajectories(networks, [slow, *paths[1:]], 5)


def test_dumps_of_packings_to_a_transfer_by_the_command(grains, moved, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
    monkeypatch.chdir(tmp_path)
    for i in range(9):
        Path(f"wave-{i + 1}.dump").write_text(dump(grains, single(moved, i)))
    Path("wave.reference.dump").write_text(dump(grains, at_rest(grains)))
    words = ["import", "wave-?.dump", "--reference", "{group}.reference.dump", "--n-bands", "5", "--out", "data"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", FramesWarning)
        # The motion is a millionth of the places, whose 16 digits leave it ten.
        assert cli.main(words) == 0
    assert "mixed, least squares of condition" in capsys.readouterr().out
    found = tc.open("data").transfer
    direct = tc.BandTransfer.from_trajectories([grains] * 9, [single(moved, i) for i in range(9)], 5)
    torch.testing.assert_close(found.mean, direct.mean, rtol=0, atol=1e-6)
    assert cli.main(["rerun", "data"]) == 0
    assert cli.main([*words[:-2], "--largest", "0.1", "--out", "none"]) == 2
    errors = capsys.readouterr().err
    assert "n_shells must leave a wavevector of the box in every shell" in errors
    assert errors.count("\n") == 1
    assert not os.path.exists("none")
