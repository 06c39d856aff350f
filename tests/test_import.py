"""Runs of other codes, from their files to a calibrated model: in Python and by the command."""

import dataclasses
import gzip
import os
import shutil
import warnings
from pathlib import Path

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.cli import choices, flags, outputs
from torchchain.frames import FORMATS, FramesWarning

DUMPS = Path(__file__).parent / "data" / "lammps"
RUNS, REFERENCE = str(DUMPS / "linear-*.dump.gz"), "{group}.reference.dump"
GOOD = ["--reference", REFERENCE, "--n-bands", "3"]
N, B = 32, 4
TIMES = torch.arange(0.0, 12.0, dtype=torch.float64)


def scene(**more):
    fields = {"n_particles": N, "n_bands": B, "realizations": 5, "times": TIMES, "disorder": tc.Disorder(strength=0.3)}
    return tc.Scene(**fields | more)


def moved(chain, state):
    return tc.evolve(chain, state, TIMES, method="modes")


def singly(chain, path):
    """The runs of a batch (realization, source, ...) one by one."""
    chains, paths = [], []
    for r, masses in enumerate(chain.masses):
        for s in range(path.displacement.shape[1]):
            chains.append(dataclasses.replace(chain, masses=masses))
            paths.append(tc.Trajectory(path.times, path.displacement[r, s], path.velocity[r, s]))
    return chains, paths


def mixed(chain, n_runs, seed=0):
    """Starts that are random sums of standing waves, (realization, run, particle)."""
    waves = tc.standing_wave(chain, list(range(1, N // 2)), amplitude=1e-3).displacement
    generator = torch.Generator().manual_seed(seed)
    shape = (len(chain.masses), n_runs, waves.shape[1])
    sums = torch.einsum("rnw,rwx->rnx", torch.randn(shape, dtype=torch.float64, generator=generator), waves)
    return tc.State(sums, torch.zeros_like(sums))


# In Python


def test_dumps_to_a_model_in_six_lines():
    frames = [tc.read_frames(DUMPS / f"linear-{r}-{s}.dump.gz") for r in (1, 2) for s in (1, 2, 3)]
    chains = [each.chain("periodic") for each in frames]
    references = [DUMPS / f"linear-{r}.reference.dump.gz" for r in (1, 2) for s in (1, 2, 3)]
    paths = [each.trajectory(reference) for each, reference in zip(frames, references, strict=True)]
    transfer = tc.BandTransfer.from_trajectories(chains, paths, n_bands=3, provenance="LAMMPS, harmonic bonds")
    master = tc.calibrate(transfer)

    assert master.n_bands == 3
    # The same chains by the library, exactly: LAMMPS's time step of 0.005 leaves (w dt)^2 / 24 t = 2e-5 of the phase.
    chain = tc.Chain(torch.stack([chains[0].masses, chains[3].masses]))
    start = tc.standing_wave(chain, [1, 3, 5])
    path = tc.evolve(chain, start, transfer.times, method="modes")
    exact = tc.band_energy(chain, path, 3).mean(0)
    assert float((transfer.mean - exact).abs().max()) < 1e-3
    assert float((transfer.long_time - tc.long_time_band_energy(chain, start, 3).mean(0)).abs().max()) < 1e-9
    assert transfer.attributes["start_condition"] == 1
    assert transfer.scene is None


def test_trajectories_give_the_transfer_of_the_ensemble():
    expected = tc.band_transfer(scene(), method="modes")
    chain = scene().chain(range(5))
    path = moved(chain, scene().state(chain))
    found = tc.BandTransfer.from_trajectories(chain, path, B)
    for name in ("mean", "stderr", "long_time", "long_time_stderr"):
        assert float((getattr(found, name) - getattr(expected, name)).abs().max()) < 1e-10, name
    assert found.attributes["mass_mean"] == pytest.approx(expected.attributes["mass_mean"], rel=1e-12)
    assert found.attributes["mass_sd"] == pytest.approx(expected.attributes["mass_sd"], rel=1e-10)

    chains, paths = singly(chain, path)
    order = torch.randperm(len(chains), generator=torch.Generator().manual_seed(3)).tolist()
    shuffled = tc.BandTransfer.from_trajectories([chains[i] for i in order], (paths[i] for i in order), B)
    assert float((shuffled.mean - found.mean).abs().max()) < 1e-12
    assert float((shuffled.stderr - found.stderr).abs().max()) < 1e-12
    assert shuffled.block_counts == found.block_counts


def test_runs_of_one_chain_whose_stiffness_is_known_nearly():
    """As from contact lists of moving particles; other contacts are another chain, whatever its masses."""
    chain = scene().chain(range(2))
    chains, paths = singly(chain, moved(chain, scene().state(chain)))
    generator = torch.Generator().manual_seed(0)
    stiff = [1 + 1e-7 * torch.randn(N, dtype=torch.float64, generator=generator) for _ in chains]
    nearly = [dataclasses.replace(c, stiffness=k) for c, k in zip(chains, stiff, strict=True)]
    found = tc.BandTransfer.from_trajectories(nearly, paths, B)
    assert sum(found.block_counts) == 2
    assert float((found.mean - tc.BandTransfer.from_trajectories(chains, paths, B).mean).abs().max()) < 1e-5
    others = [dataclasses.replace(c, stiffness=stiff[i] + 0.02 * (i % 2)) for i, c in enumerate(chains)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FramesWarning)  # these paths are of the other contacts
        assert sum(tc.BandTransfer.from_trajectories(others, paths, B).block_counts) == 4


def test_a_band_that_a_chain_lacks():
    """Of pure starts with gaps each source is the mean of its own runs."""
    chain = scene().chain(range(5))
    chains, paths = singly(chain, moved(chain, scene().state(chain)))
    transfer = tc.BandTransfer.from_trajectories(chains[:-1], paths[:-1], B)
    energies = torch.stack([tc.band_energy(c, p, B) for c, p in zip(chains, paths, strict=True)])
    for source in range(B):
        own = energies[source::B][: 5 - (source == B - 1)]
        assert float((transfer.mean[source] - own.mean(0)).abs().max()) < 1e-12
    # All starts count alike, but for the one that is missing: sqrt(5 / 5) after scaling.
    assert transfer.attributes["start_condition"] == pytest.approx(1, abs=1e-12)


def test_mixed_starts_go_through_least_squares(tmp_path):
    chain = scene(realizations=8).chain(range(8))
    start = mixed(chain, 3)
    path = moved(chain, start)
    transfer = tc.BandTransfer.from_trajectories(chain, path, B)
    energies = tc.band_energy(chain, path, B).flatten(0, 1)
    starts = energies[:, 0]

    def solved(values):
        return torch.linalg.solve(starts.T @ starts, starts.T @ values)

    for t in (0, 5, 11):
        assert float((transfer.mean[:, t] - solved(energies[:, t])).abs().max()) < 1e-9
    late = tc.long_time_band_energy(chain, start, B).flatten(0, 1)
    assert float((transfer.long_time - solved(late)).abs().max()) < 1e-9
    scaled = starts / starts.norm(dim=0)
    assert transfer.attributes["start_condition"] == pytest.approx(float(torch.linalg.cond(scaled)), rel=1e-9)
    assert transfer.block_counts == (1,) * 8
    # from_energies with the same starts is the same.
    shaped = energies.reshape(8, 3, len(TIMES), B)
    same = tc.BandTransfer.from_energies(TIMES, shaped, late.reshape(8, 3, B), starts=shaped[:, :, 0])
    for name in ("mean", "stderr", "long_time", "long_time_stderr"):  # shares of order 1, condition below 100
        assert float((getattr(same, name) - getattr(transfer, name)).abs().max()) < 1e-9, name
    transfer.save(tmp_path / "transfer.nc")
    again = tc.BandTransfer.load(tmp_path / "transfer.nc")
    assert again.attributes == transfer.attributes
    assert torch.equal(again.mean, transfer.mean)


def test_as_many_mixed_runs_as_bands():
    """Where the long-time average of the runs has the shape of one of the bands, it is still that of the runs."""
    chain = scene(realizations=1).chain([0])
    start = mixed(chain, B)
    transfer = tc.BandTransfer.from_trajectories(chain, moved(chain, start), B)
    late = tc.long_time_band_energy(chain, start, B)[0]
    starts = tc.band_energy(chain, moved(chain, start), B)[0, :, 0]
    assert float((starts @ transfer.long_time - late).abs().max()) < 1e-9
    assert bool(transfer.stderr.isinf().all())


def test_a_known_transfer_is_recovered_from_starts():
    generator = torch.Generator().manual_seed(0)
    known = torch.softmax(torch.randn(B, 7, B, dtype=torch.float64, generator=generator), -1)
    starts = torch.rand(20, 2, B, dtype=torch.float64, generator=generator)
    energies = torch.einsum("nxs,str->nxtr", starts, known)
    times = torch.arange(7.0)
    found = tc.BandTransfer.from_energies(times, energies, starts=starts)
    assert float((found.mean - known).abs().max()) < 1e-11
    assert float((found.long_time - known[:, 3:].mean(1)).abs().max()) < 1e-11
    # What has not settled is in the error: half the difference of the two quarters.
    drift = (known[:, 5:].mean(1) - known[:, 3:5].mean(1)).abs() / 2
    assert bool((found.long_time_stderr > drift - 1e-11).all())
    exact = tc.BandTransfer.from_energies(times, energies, known[:, -1], starts=starts)
    assert torch.equal(exact.long_time, known[:, -1])
    assert float(exact.long_time_stderr.max()) == 0


@pytest.mark.filterwarnings("ignore:run 1, frame .* energy")
def test_the_late_part_serves_where_modes_do_not():
    ring = scene().chain(range(5))
    damped = dataclasses.replace(ring, damping=0.05)
    path = tc.evolve(damped, scene().state(ring), TIMES, method="damped")
    found = tc.BandTransfer.from_trajectories(damped, path, B)
    late = tc.BandTransfer.from_trajectories(ring, path, B, long_time="late")
    assert torch.equal(found.long_time, late.long_time)
    energies = tc.band_energy(ring, path, B)
    assert float((found.long_time - energies[:, :, TIMES >= 5.5].mean((0, 2))).abs().max()) < 1e-12
    given = torch.eye(B, dtype=torch.float64)
    assert torch.equal(tc.BandTransfer.from_trajectories(ring, path, B, long_time=given).long_time, given)


def test_what_is_wrong_is_named():
    chain = scene().chain(range(5))
    chains, paths = singly(chain, moved(chain, scene().state(chain)))
    build = tc.BandTransfer.from_trajectories
    with pytest.raises(FieldError, match="trajectories must be as many as chains, got 19 of them"):
        build(chains, paths[:-1], B)
    with pytest.raises(FieldError, match="trajectories must be as many as chains, got more than 19"):
        build(chains[:-1], paths, B)
    with pytest.raises(FieldError, match="chains must be at least one"):
        build([], [], B)
    with pytest.raises(FieldTypeError, match="chains, run 1 must be a Chain or a Network, got 3"):
        build([3], paths, B)
    with pytest.raises(FieldTypeError, match="chains must be one for each run, got 3"):
        build(3, paths, B)
    other = tc.Trajectory(TIMES[:-1], paths[1].displacement[:-1], paths[1].velocity[:-1])
    with pytest.raises(FieldError, match=r"run 2: times must be those of the first run \(12 to 11\), got 11 to 10"):
        build(chains, [paths[0], other, *paths[2:]], B)
    still = tc.Trajectory(TIMES, torch.zeros_like(paths[0].displacement), torch.zeros_like(paths[0].velocity))
    with pytest.raises(FieldError, match="run 1: total energy must be positive"):
        build(chains[:1], [still], B)
    with pytest.raises(FieldError, match="starts must excite every band in some run, got none in band 4"):
        build(chains[:3], paths[:3], B)
    # All bands are excited, but one of them on one chain alone: there is no standard error.
    with pytest.raises(
        FieldError, match=r"excite every band in runs on at least 2 chains.*got band 4 on 1 of 2 chains"
    ):
        build(chains[:7], paths[:7], B)
    c, p = singly(chain, moved(chain, mixed(chain, 2)))
    with pytest.raises(FieldError, match="starts must tell the 4 bands apart .* got infinite with 2 runs"):
        build(c[:2], p[:2], B)
    with pytest.raises(FieldError, match="long_time must be one of late"):
        build(chains, paths, B, long_time="early")
    with pytest.raises(FieldError, match=r"starts must have shape \(5, 2, 4\)"):
        tc.BandTransfer.from_energies([0.0, 1.0], torch.rand(5, 2, 2, 4), starts=torch.rand(5, 3, 4))


def test_energy_that_drifts_is_named():
    """Trajectories of a damped chain that are said to be of one without damping."""
    ring = scene().chain(range(2))
    damped = dataclasses.replace(ring, damping=0.05)
    path = tc.evolve(damped, scene().state(ring), TIMES, method="damped")
    with pytest.warns(FramesWarning, match=r"run 1, frame \d+: energy: 0\.\d+ of that of frame 1, for a chain without"):
        tc.BandTransfer.from_trajectories(ring, path, B)
    chains, paths = singly(ring, path)
    exact = singly(ring, moved(ring, scene().state(ring)))[1]
    names = [f"run-{i}.dump" for i in range(len(chains))]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tc.BandTransfer.from_trajectories(chains, [*exact[:-1], paths[-1]], B, names=names)
        tc.BandTransfer.from_trajectories(damped, path, B)  # which may lose energy
    assert [str(each.message).partition(",")[0] for each in caught] == [names[-1]]


def pure(generator, realizations=4, late=5):
    """Energies of runs that start in one band each, (realization, source, time, receiver)."""
    left = torch.exp(-torch.arange(late + 1, dtype=torch.float64))[:, None]
    spread = torch.softmax(torch.randn(realizations, B, late + 1, B, generator=generator, dtype=torch.float64), -1)
    return left * torch.eye(B, dtype=torch.float64)[:, None] + (1 - left) * spread


def scaled(factor, *place):
    def change(energies):
        energies[place] *= factor
        return energies

    return change


NO_SHARES = {
    "joules": (scaled(1e-9), r"be shares of the energy of each run, 1 in all .* got 1e-09 in all at realization 1, source 1"),
    "one run in other units": (scaled(2.0, 2, 1), "got 2 in all at realization 3, source 2"),
    "a run without energy": (scaled(0.0, 2, 1), "got 0 in all at realization 3, source 2"),
    "a spike": (scaled(3.0, 0, 3, 4), "got 3 in all at realization 1, source 4"),
    "sources and receivers in other orders": (lambda e: e.flip(1), "start in the band of their source .* got 0 of the energy of source 1"),
    "negative": (lambda e: -e, "be shares of the energy of each run"),
}  # fmt: skip


@pytest.mark.parametrize("case", NO_SHARES)
def test_energies_that_are_no_shares(case):
    change, words = NO_SHARES[case]
    energies = pure(torch.Generator().manual_seed(1))
    tc.BandTransfer.from_energies(torch.arange(6.0), energies)
    with pytest.raises(FieldError, match=f"energies must .*{words}"):
        tc.BandTransfer.from_energies(torch.arange(6.0), change(energies))


def told(call):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = call()
    return found, [str(each.message) for each in caught]


def test_doubtful_energies_are_named():
    energies, times = pure(torch.Generator().manual_seed(1)), torch.arange(6.0)

    def build(changed, **more):
        return told(lambda: tc.BandTransfer.from_energies(times, changed, **more))

    assert build(energies)[1] == []
    noisy = energies.clone()
    noisy[1, 2, 3] *= 1.2
    found, words = build(noisy)
    assert words == ["energies: 1.2 in all at realization 2, source 3, time 4: scaled to 1"]
    assert float(found.mean.sum(-1).max()) <= 1 + 1e-15
    negative = energies.clone()
    negative[0, 0, 5] = torch.tensor([0.9, -0.3, 0.2, 0.2])
    assert build(negative)[1] == ["energies: negative, -0.3 at realization 1, source 1, time 6"]
    lost = energies * torch.exp(-0.2 * times)[:, None]
    assert "energies: down to 0.368 of those at the first time, at source" in build(lost)[1][0]
    smeared = 0.9 * energies + 0.1 * energies.flip(1)
    assert "energies: 0.9 of the energy of source 1 in its own band at time 0: starts=" in build(smeared)[1][0]
    undone, words = build(smeared, starts=smeared[:, :, 0])
    assert words == []
    assert float((undone.mean[:, 0] - torch.eye(B)).abs().max()) < 1e-12
    with pytest.raises(FieldError, match="starts must not be negative by more than a tenth, got -"):
        tc.BandTransfer.from_energies(times, energies, starts=-energies[:, :, 0])


def test_runs_that_move_as_a_whole():
    ring = scene().chain(range(5))
    start = scene().state(ring)
    for speed, known in ((1e-4, None), (2e-3, "warning"), (0.1, "error")):
        state = tc.State(start.displacement, start.velocity + speed)
        path = moved(ring, state)
        if known == "error":
            with pytest.raises(FieldError, match=r"run 1, frame 1: velocities must be those of a wave, got 0\.9"):
                tc.BandTransfer.from_trajectories(ring, path, B)
            continue
        _, words = told(lambda path=path: tc.BandTransfer.from_trajectories(ring, path, B))
        assert len(words) == (known == "warning")
        assert all("run 1, frame 1: velocities: 0." in line and "motion as a whole" in line for line in words)


def test_energies_that_stay_where_they_are():
    """Of equal masses, by anyone: all of it is basis energy."""
    energies = torch.eye(B, dtype=torch.float64).expand(5, 6, B, B).transpose(1, 2)
    master = tc.calibrate(tc.BandTransfer.from_energies(torch.arange(6.0), energies))
    assert float(master.rates.detach().abs().max()) == 0


@pytest.mark.parametrize("own", [True, False], ids=["scene", "data"])
def test_without_a_long_time_average_the_late_part_serves(own, small_transfer):
    """The model is not the paper's for want of it."""
    bare = dataclasses.replace(small_transfer, long_time=None, long_time_stderr=None, block_long_time=None)
    bare = bare if own else dataclasses.replace(bare, scene=None, provenance=tc.Provenance("imported", "a notebook"))
    with pytest.warns(tc.FitWarning, match=r"no long-time average: taken over the later half of its times, t >= 2\.5"):
        master = tc.calibrate(bare, bootstrap=0)
    assert master.calibration.model not in ("paper", "exact_psi")
    late = small_transfer.times >= 2.5
    named = "basis_matrix"
    with pytest.warns(tc.FitWarning, match="standard error up to"):
        linear = tc.calibrate(bare, "linear", bootstrap=0)
    assert linear.calibration.model == named
    assert float((linear.model.basis - bare.mean[:, late].mean(1)).abs().max()) < 1e-9
    with pytest.raises(FieldError, match="must hold the long-time average"):
        tc.calibrate(bare, model=named)


# The commands


def test_a_folder_of_dumps_to_a_model_in_one_command(run, tmp_path):
    status, output, errors = run("import", RUNS, *GOOD, "--out", "data", "--calibrate", "model")
    assert (status, errors) == (0, "")
    assert "memory, fitted by projection" in output
    assert {"model.safetensors", "figure.png", "transfer.nc"} <= set(os.listdir("model"))
    opened = tc.open("model")
    assert torch.equal(opened.transfer.mean, tc.open("data").transfer.mean)
    assert opened.master.n_bands == 3
    for folder in ("data", "model"):
        assert run("rerun", folder)[0] == 0
    for words in (("--out", "same", "--calibrate", "same"), ("--calibrate", ""), ("--calibrate", DUMPS / "linear.kinetic.txt")):  # fmt: skip
        status, output, errors = run("import", RUNS, *GOOD, *words)
        assert (status, output, errors.count("\n")) == (2, "", 1)
    assert sorted(os.listdir(tmp_path)) == ["data", "model"]


def written(columns, path, text=""):
    """A stored run with other columns: type in place of mass, and radius."""
    for frame in tc.read_frames(DUMPS / "linear-1-1.dump.gz"):
        text += f"ITEM: TIME\n{frame.time:.17g}\nITEM: TIMESTEP\n{frame.step}\nITEM: NUMBER OF ATOMS\n12\n"
        text += f"ITEM: BOX BOUNDS pp pp pp\n0 12\n-2 2\n-2 2\nITEM: ATOMS {columns}\n"
        for i in range(12):
            known = {
                "id": i + 1,
                "type": 1 + i % 2,
                "radius": 0.5,
                "xu": frame.positions[i, 0],
                "vx": frame.velocities[i, 0],
            }
            text += " ".join(f"{float(known[name]):.17g}" for name in columns.split()) + "\n"
    path.write_text(text)


@pytest.mark.parametrize("kind", ["type", "radius"])
def test_masses_by_flags(kind, run, tmp_path):
    """A dict of types, or a density; each of them one line where it is wrong."""
    written(f"id {kind} xu vx", tmp_path / "run.dump")
    good, bad = {
        "type": (["--masses", "1=0.9,2=1.1"], ["1=0.9", "1=0.9,2", "1=0.9,1=1.1", "one=1,2=1", "1=0.9,2=-1", "1=0.9,2=heavy"]),
        "radius": (["--density", "2"], ["-1", "0"]),
    }[kind]  # fmt: skip
    assert run("convert", "run.dump", "run.nc", *good)[0] == 0
    masses = tc.read_frames("run.nc").masses
    expected = torch.tensor([0.9, 1.1]).repeat(6) if kind == "type" else 2 * 4 / 3 * torch.pi * torch.full((12,), 0.125)
    assert float((masses - expected).abs().max()) < 1e-6
    for word in bad:
        status, output, errors = run("convert", "run.dump", "bad.nc", good[0], word)
        assert (status, output, errors.count("\n")) == (2, "", 1), word
    assert sorted(os.listdir(tmp_path)) == ["run.dump", "run.nc"]


def test_mercury_runs_by_the_command(run, tmp_path):
    """Masses from the .restart beside a run, a box that the user says is periodic, contacts from .fstat."""
    ring = scene(realizations=2).chain(range(2))
    path = moved(ring, scene().state(ring))
    rest, radius = torch.arange(N) + 0.5, 0.55
    for r, masses in enumerate(ring.masses):
        restart = "MercuryDPM 1.0 name run\nxMin 0\n" + f"Particles {N}\n" + "".join(
            f"SphericalParticle id {i} indSpecies 0 position 0 0 0 radius {radius} invMass {1 / m:.17g} timeStamp 0\n"
            for i, m in enumerate(masses.tolist())
        )  # fmt: skip
        for s in range(B):
            for name, moves in ((f"run{r}-{s}", range(len(TIMES))), (f"rest{r}-{s}", [None])):
                data = contacts = ""
                for k in moves:
                    x, v = (
                        (rest, 0 * rest) if k is None else (rest + path.displacement[r, s, k], path.velocity[r, s, k])
                    )
                    data += f"{N} {k or 0} 0 -1 -1 {N} 1 1 \n"
                    data += "".join(
                        f"{a % N:.17g} 0 0 {b:.17g} 0 0 {radius} 0 0 0 0 0 0 0\n"
                        for a, b in zip(x.tolist(), v.tolist(), strict=True)
                    )
                    contacts += f"# {k or 0} 1\n# 0 -1 -1 {N} 1 1\n# {radius} {radius} 0 0 0 0\n"
                    for i in range(N):
                        overlap = 2 * radius - float((x.roll(-1) - x)[i] % N)
                        for a, b in ((i, (i + 1) % N), ((i + 1) % N, i)):
                            contacts += f"0 {a} {b} 0 0 0 {overlap:.17g} 0 {overlap:.17g} 0 1 0 0 0 0 0\n"
                (tmp_path / f"{name}.data").write_text(data)
                (tmp_path / f"{name}.fstat").write_text(contacts)
                (tmp_path / f"{name}.restart").write_text(restart)
    words = ["--reference", "rest{1}-{2}.data", "--periodic", "x", "--n-bands", B]
    assert run("import", "run*.data", *words, "--out", "data")[::2] == (0, "")
    exact = tc.BandTransfer.from_trajectories(ring, path, B)
    found = tc.open("data").transfer
    assert float((found.mean - exact.mean).abs().max()) < 1e-9
    assert found.block_counts == exact.block_counts
    # Stiffness 1 and overlap 0.1 from the contact lists, and the mean mass: the same chains in other units of time.
    words += ["--contacts", "{stem}.fstat", "--units", "linear"]
    assert run("import", "run*.data", *words, "--out", "scaled")[::2] == (0, "")
    scaled = tc.open("scaled").transfer
    assert scaled.block_counts == exact.block_counts
    assert float(scaled.times[-1] / found.times[-1]) == pytest.approx(float(ring.masses.mean()) ** -0.5, rel=1e-9)


def test_doubts_that_many_runs_share_are_told_once(run, tmp_path):
    """Damped runs of a chain that is said not to be, until the damping is named."""
    ring = scene(realizations=2).chain(range(2))
    damped = dataclasses.replace(ring, damping=0.05)
    chains, paths = singly(ring, tc.evolve(damped, scene().state(ring), TIMES, method="damped"))
    rest = torch.arange(N) + 0.5
    for i, (chain, path) in enumerate(zip(chains, paths, strict=True)):
        for name, moves in ((f"run-{i}.dump", range(len(TIMES))), (f"run-{i}.rest.dump", [None])):
            text = ""
            for k in moves:
                x, v = (rest, 0 * rest) if k is None else (rest + path.displacement[k], path.velocity[k])
                text += f"ITEM: TIME\n{k or 0}\nITEM: TIMESTEP\n{k or 0}\nITEM: NUMBER OF ATOMS\n{N}\n"
                text += f"ITEM: BOX BOUNDS pp pp pp\n0 {N}\n-2 2\n-2 2\nITEM: ATOMS id mass xu vx\n"
                rows = zip(range(1, N + 1), chain.masses.tolist(), x.tolist(), v.tolist(), strict=True)
                text += "".join(f"{n} {m:.17g} {a:.17g} {b:.17g}\n" for n, m, a, b in rows)
            (tmp_path / name).write_text(text)
    command = ["import", "run-*.dump", "--reference", "{stem}.rest.dump", "--n-bands", B]
    with pytest.warns(FramesWarning) as caught:
        assert run(*command, "--out", "plain")[0] == 0
    (words,) = (str(each.message) for each in caught)
    assert words.startswith("run-0.dump, frame 12: energy: 0.")
    assert words.endswith("(and 7 more like this)")
    status, _, errors = run(*command, "--damping", "0.05", "--out", "damped")
    assert (status, errors) == (0, "")
    late = tc.open("damped").transfer
    assert float((late.long_time - late.mean[:, TIMES >= 5.5].mean(1)).abs().max()) < 1e-12


def test_import_calibrate_predict(run, tmp_path):
    status, output, errors = run("import", RUNS, *GOOD, "--out", "data")
    assert (status, errors) == (0, "")
    assert "starts: one band each" in output
    assert sorted(os.listdir("data")) == ["config.toml", "figure.png", "report.html", "run.json", "transfer.nc"]
    assert os.listdir(tmp_path) == ["data"]
    opened = tc.open("data")
    assert opened.scene is None
    record = opened.record
    assert set(record["files"]) == {"config.toml", "transfer.nc", "figure.png", "report.html"}
    assert len(record["inputs"]) == 8  # six runs and two references
    for name, value in record["inputs"].items():
        assert outputs.sha256(name) == value
    transfer = opened.transfer
    assert transfer.provenance.hashes | record["inputs"] == transfer.provenance.hashes
    frames = [tc.read_frames(DUMPS / f"linear-{r}-{s}.dump.gz") for r in (1, 2) for s in (1, 2, 3)]
    paths = [each.trajectory(DUMPS / f"{each.name[:8]}.reference.dump.gz") for each in frames]
    direct = tc.BandTransfer.from_trajectories([each.chain() for each in frames], paths, 3)
    assert torch.equal(transfer.mean, direct.mean)
    assert torch.equal(transfer.long_time, direct.long_time)
    status, output, _ = run("calibrate", "--transfer", "data", "--bootstrap", "0", "--out", "model")
    assert status == 0
    assert "6 runs of 12 particles" in output
    assert run("predict", "model", "--times.stop", "10", "--out", "later")[0] == 0
    assert tc.open("model").master.n_bands == 3
    # A prediction against the data: the same axes, at the times that both have.
    status, output, errors = run("compare", "later", "model", "--out", "compared")
    assert (status, errors) == (0, "")
    assert "band_energy: 54 values, largest difference " in output
    found = tc.open("compared").record["summary"]["band_energy"]
    predicted = tc.open("model").master.transfer(transfer.times).detach()
    expected = tc.total_variation(predicted, transfer.mean)[:, 1:].mean()
    assert found["total_variation"] == pytest.approx(float(expected), abs=1e-9)


def test_an_import_is_made_again(run, tmp_path):
    """From any folder, to the last bit; in one line where a file has changed or is gone."""
    os.mkdir("runs")
    for name in ("linear-1-1.dump.gz", "linear-1-2.dump.gz", "linear-1-3.dump.gz", "linear-1.reference.dump.gz"):
        shutil.copy(DUMPS / name, tmp_path / "runs")
    words = ["--reference", "runs/{group}.reference.dump", "--n-bands", 3, "--units", "mass"]
    assert run("import", "runs/linear-*.gz", *words, "--out", "data")[0] == 0
    os.mkdir("elsewhere")
    os.chdir("elsewhere")
    status, output, errors = run("rerun", "../data")
    assert (status, errors) == (0, "")
    assert output == "transfer.nc: equal to the last bit\n"
    assert run("rerun", "../data", "--out", "again")[0] == 0
    assert run("rerun", "again")[0] == 0
    changed = tmp_path / "runs" / "linear-1-2.dump.gz"
    held = changed.read_bytes()
    changed.write_bytes(gzip.compress(gzip.decompress(held)))
    status, output, errors = run("rerun", "../data")
    assert (status, output) == (2, "")
    assert "inputs must have the SHA-256" in errors
    assert f"in {changed}" in errors
    changed.unlink()
    status, output, errors = run("rerun", "../data")
    assert (status, output, errors.count("\n")) == (2, "", 1)
    assert "inputs must be where the run found it" in errors
    assert f"got no file {changed}" in errors


def test_names_of_references(run, tmp_path):
    """{stem}, {name}, a folder of its own, and files that are not packed."""
    shutil.copy(DUMPS / "linear-1-1.dump.gz", tmp_path / "a.b.dump.gz")
    shutil.copy(DUMPS / "linear-1-2.dump.gz", tmp_path / "c.dump.gz")
    shutil.copy(DUMPS / "linear-1-3.dump.gz", tmp_path / "d.dump.gz")
    rest = DUMPS / "linear-1.reference.dump.gz"
    os.mkdir("at_rest")
    for template, name in (
        ("{stem}.reference.dump", "{}.reference.dump.gz"),
        ("at_rest/{stem}", "at_rest/{}"),
        ("at_rest/{name}", "at_rest/{}.dump.gz"),
        ("at_rest/{1}", "at_rest/{}"),
    ):
        if "{1}" in template:  # the first number in a name
            for old, new in (("a.b", "e-1-x"), ("c", "e-2"), ("d", "e3")):
                os.rename(f"{old}.dump.gz", f"{new}.dump.gz")
        for stem in ("a.b", "c", "d") if "{1}" not in template else ("1", "2", "3"):
            shutil.copy(rest, name.format(stem))
        status, output, errors = run("import", "*.dump.gz", "--reference", template, "--n-bands", 3, "--out", "out")
        assert (status, errors) == (0, ""), template
        assert "3 runs of 12 particles" in output
        for path in Path().glob("*.reference.dump.gz"):
            path.unlink()


def test_units_of_mass_and_stiffness(run, tmp_path):
    """The same runs in other units: masses times 3, times times 2, stiffness 3 / 4, lengths as they are."""
    for run_number in (1, 2, 3):
        frames = tc.read_frames(DUMPS / f"linear-1-{run_number}.dump.gz")
        rest = tc.read_frames(DUMPS / "linear-1.reference.dump.gz")
        for each, name in ((frames, f"{run_number}.dump"), (rest, f"{run_number}.reference.dump")):
            text = ""
            for frame in each:
                head = f"ITEM: TIME\n{2 * frame.time:.17g}\nITEM: TIMESTEP\n{frame.step}\nITEM: NUMBER OF ATOMS\n12\n"
                text += head + "ITEM: BOX BOUNDS pp pp pp\n0 12\n-2 2\n-2 2\nITEM: ATOMS id mass xu vx\n"
                for i in range(12):
                    values = (3 * frame.masses[i], frame.positions[i, 0], frame.velocities[i, 0] / 2)
                    text += f"{i + 1} {' '.join(f'{float(v):.17g}' for v in values)}\n"
            (tmp_path / name).write_text(text)
    words = ["--reference", "{stem}.reference.dump", "--n-bands", 3]
    status, _, errors = run("import", "?.dump", *words, "--units", "mass", "--stiffness", 0.75, "--out", "scaled")
    assert (status, errors) == (0, "")
    run("import", str(DUMPS / "linear-1-?.dump.gz"), *GOOD, "--out", "plain")
    scaled, plain = tc.open("scaled").transfer, tc.open("plain").transfer
    assert scaled.attributes["mass_mean"] == pytest.approx(1, abs=1e-12)
    assert (
        float((scaled.mean - plain.mean).abs().max()) < 1e-6
    )  # the dumps round at 1e-15 of positions for waves of 0.01
    ratio = scaled.times[-1] / plain.times[-1]
    assert float(ratio) == pytest.approx(plain.attributes["mass_mean"] ** -0.5, rel=1e-12)


def test_convert(run, tmp_path):
    source = DUMPS / "linear-1-1.dump.gz"
    status, output, errors = run("convert", source, "one.nc")
    assert (status, errors) == (0, "")
    assert "6 frames of 12 particles" in output
    assert os.listdir(tmp_path) == ["one.nc"]
    assert torch.equal(tc.read_frames("one.nc").positions, tc.read_frames(source).positions)


MISTAKES = [
    ("import", "runs must be at least one file"),
    ("import nothing*.dump", "runs must match at least one file, got 'nothing*.dump'"),
    ("import nothing.dump", "runs must be files, got no file nothing.dump"),
    ("import .", "runs must be files, got a folder"),
    ("import RUN RUN", "runs must be given once"),
    ("import RUN --reference {step}.dump", "reference must be a file name that holds no other braces"),
    ("import RUN --reference no.dump", "reference must be a file beside linear-1-1.dump.gz, got no file"),
    ("import RUN --boundary fixed", "boundary must be 'periodic' for wavenumber bands"),
    ("import RUN --contact hertz", "contact must be left out for chains, whose bands are of linear contacts, got hertz"),
    ("import RUN --largest 3", "largest must be left out for chains, whose bands have equal widths, got 3"),
    ("import RUN --n-bands 5", "n_bands must divide the number of tones n_particles/2 = 6, got 5"),
    ("import RUN --n-bands 0", "n_bands must be at least 1"),
    ("import RUN --n-bands 3", "linear-1-1.dump.gz: total energy must be positive"),
    ("import RUN --n-bands 3 --reference {group}.reference.dump", "starts must excite every band in some run, got none in band 2"),
    ("import RUN --units hertz", "contacts must be given for units hertz"),
    ("import RUN --stiffness linear", "contacts must be given for stiffness linear"),
    ("import RUN --stiffness soft", "stiffness must be a number, linear or hertz, got 'soft'"),
    ("import RUN --n-bands 3 --axis y", "linear-1-1.dump.gz, frame 1: y must be in the file"),
    ("import RUN --time-step 1", "time_step must be left out"),
    ("import RUN --masses 1", "masses must be left out"),
    ("import RUN --damping -1", "damping must be at least 0"),
    ("import RUN --periodic q", "periodic must be axes such as 'x' or 'xy'"),
    ("import RUN --contact-columns id", "contacts must be given for contact_columns"),
    ("import RUN --contacts RUN --contact-columns id1=c_1[1],id2", "contact_columns must read name=value"),
    ("import RUN --format xyzz", "format must be one of lammps, mercury, xyz, netcdf"),
    ("import KINETIC", "linear.kinetic.txt, frame 1: header must give"),
    ("convert", "run must be a file"),
    ("convert RUN", "out must be a file"),
    ("convert nothing.dump one.nc", "path must be a file that can be read, got nothing.dump"),
    ("convert RUN nowhere/one.nc", "out must be a file in a folder that is there"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "message"), MISTAKES)
def test_mistakes_are_one_line(words, message, run, tmp_path):
    files = {"RUN": str(DUMPS / "linear-1-1.dump.gz"), "KINETIC": str(DUMPS / "linear.kinetic.txt")}
    status, output, errors = run(*(files.get(word, word) for word in words.split()))
    assert status == 2
    assert output == ""
    assert errors.startswith("torchchain: error: ")
    assert message in errors
    assert errors.count("\n") == 1
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("word", ["nan", "-inf", "-1", "1e300", "word", "", "99999999999999999999"])
@pytest.mark.parametrize("flag", sorted({e.name for e in dataclasses.fields(flags.Import)} - {"runs", "out"}))
def test_hostile_words(flag, word, run, tmp_path):
    begin = ["import", DUMPS / "linear-1-1.dump.gz", "--n-bands", "3"]
    status, output, errors = run(*begin, f"--{flag.replace('_', '-')}", word)
    assert status == 2
    assert output == ""
    assert errors.startswith("torchchain: error: ")
    assert errors.count("\n") == 1
    assert os.listdir(tmp_path) == []


def test_a_failed_write_leaves_what_was_there(run, tmp_path, monkeypatch):
    def broken(drawn):
        def writer(path):
            raise OSError(28, "No space left on device")

        return writer

    monkeypatch.setattr(outputs, "figure", broken)
    status, _, errors = run("import", RUNS, *GOOD, "--out", "data")
    assert status == 2
    assert "No space left on device" in errors
    assert not (tmp_path / "data").exists() or os.listdir("data") == []


def test_help_lists_the_formats():
    assert tuple(name for name, known in FORMATS.items() if known.holds == "particles") == choices.FORMATS


# Networks


def test_grains_of_a_dump_are_a_packing(tmp_path):
    """Four disks in a periodic square: contacts across the box, masses and frames in the order of the ids."""
    rows = [
        "3 0.5 1.3 0.05 0.95 0 0",
        "1 0.5 1.1 0.05 0.05 0 0",
        "4 0.5 1.4 0.95 0.95 0 0",
        "2 0.5 1.2 0.95 0.05 0 0.1",
    ]
    head = "ITEM: TIME\n{0}\nITEM: TIMESTEP\n{0}\nITEM: NUMBER OF ATOMS\n4\nITEM: BOX BOUNDS pp pp ff\n0 1.8\n0 1.8\n-1 1\n"
    body = "ITEM: ATOMS id radius mass xu yu vx vy\n" + "\n".join(rows) + "\n"
    path = tmp_path / "grains.dump"
    path.write_text(head.format(0) + body + head.format(1) + body)
    frames = tc.read_frames(path)
    made = frames.network(stiffness=2.0)
    assert made.masses.tolist() == [1.1, 1.2, 1.3, 1.4]
    assert made.n_contacts == 8  # each touches both copies of two others, at 0.9
    assert float((made.overlaps - 0.1).abs().max()) < 1e-12
    expected = tc.packing(
        frames.first.positions,
        frames.radii,
        frames.masses,
        torch.tensor([1.8, 1.8], dtype=torch.float64),
        stiffness=2.0,
    )
    assert torch.equal(made.bonds, expected.bonds)
    assert torch.equal(made.tension, expected.tension)
    motion = frames.trajectory(axis="all")
    assert motion.velocity[-1].tolist() == [[0, 0], [0, 0.1], [0, 0], [0, 0]]
    made.check_state(motion.displacement)
    bare = tmp_path / "bare.dump"
    bare.write_text(path.read_text().replace("radius", "unknown"))
    with pytest.raises(FieldError, match="bare.dump, frame 1: radius must be in the file"):
        tc.read_frames(bare).network()
