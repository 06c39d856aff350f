"""Scenes of mixtures: energies of every species, transfers between them, checkpoints, ranks, models and commands."""

import dataclasses
import json
import warnings

import pytest
import torch
import xarray
from test_ranks import Lost

import torchchain as tc
from torchchain import cli
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.species import Species, hertz_stiffness, species_band_energy

DAMPED = (Species("soft", stiffness=0.4, damping=0.05), Species("stiff", stiffness=1.6))
UNDAMPED = (Species("soft", stiffness=0.4, fraction=0.4), Species("stiff", mass=1.2, stiffness=1.6, fraction=0.6))
SCENE = tc.Scene(
    n_particles=24, n_bands=6, species=UNDAMPED, by_species=True, times=[0.0, 0.5, 3.0, 12.0], realizations=6, seed=5,
    disorder=tc.Disorder(strength=0.2),
)  # fmt: skip


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
def test_an_ensemble_is_the_mean_over_its_chains(method):
    found = tc.simulate(SCENE, method)
    mixture, each = tc.species.Mixture(UNDAMPED), []
    for i in range(SCENE.realizations):
        chain = mixture.chain(24, [i], SCENE.seed, disorder=SCENE.disorder)
        labels = mixture.labels(24, [i], SCENE.seed)
        wave = tc.standing_wave(chain, tone=[2, 6, 10]).displacement
        speed = torch.cat([wave * (labels == s) for s in range(2)], dim=1)
        path = tc.evolve(chain, tc.State(torch.zeros_like(speed), speed), SCENE.times)
        energy = species_band_energy(chain, path, labels, 2, n_bands=3).flatten(-2)
        each.append((energy / tc.total_energy(chain, path)[..., None])[0])
    shares = torch.stack(each)
    torch.testing.assert_close(torch.from_numpy(found.band_energy.values), shares.mean(0), rtol=0, atol=1e-9)
    error = shares.std(0) / len(each) ** 0.5
    torch.testing.assert_close(torch.from_numpy(found.band_energy_stderr.values), error, rtol=0, atol=1e-9)
    torch.testing.assert_close(shares.sum(-1), torch.ones_like(shares[..., 0]), rtol=0, atol=1e-10)
    assert found.band_species.values.tolist() == ["soft"] * 3 + ["stiff"] * 3


def test_all_beads_together_and_each_species():
    names = ("band_energy", "species_energy", "total_energy", "long_time_band_energy")
    scene = dataclasses.replace(SCENE, by_species=False, energy_definition="site", observables=names)
    found = tc.simulate(scene, "modes")
    chain = scene.chain(range(6))
    path = tc.evolve(chain, tc.standing_wave(chain, tone=scene.tones), scene.times)
    mean = tc.band_energy(chain, path, n_bands=6).mean(0)
    torch.testing.assert_close(torch.from_numpy(found.band_energy.values), mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(
        torch.from_numpy(found.species_energy.sum("species").values),
        torch.from_numpy(found.total_energy.values),
        rtol=1e-10,
        atol=0,
    )
    assert set(map(str, found.species.values)) == {"soft", "stiff"}


def test_energy_kept_and_dissipated_is_that_of_the_start():
    scene = dataclasses.replace(
        SCENE, species=DAMPED, observables=("species_energy", "dissipated", "band_energy"), realizations=2
    )
    found = tc.simulate(scene, "damped")
    kept = found.species_energy.sum("species") + found.dissipated
    assert float(abs(kept / kept.isel(time=0) - 1).max()) < 1e-10
    left = found.band_energy.sum("band")
    assert float(left.isel(time=-1).max()) < 0.95
    assert tc.METHODS[tc.plan(scene).method].damped


def test_ranks_and_checkpoints_change_no_bit(tmp_path):
    scene = dataclasses.replace(SCENE, species=DAMPED)
    whole = tc.simulate(scene, "verlet", options={"step": 0.05})
    for rank in range(2):
        with pytest.raises(RuntimeError, match="has ended"):
            tc.simulate(
                scene, "verlet", options={"step": 0.05}, checkpoint=Checkpoint(tmp_path, 0), ranks=Lost(rank, 3)
            )
    again = Checkpoint(tmp_path, 0)
    found = tc.simulate(scene, "verlet", options={"step": 0.05}, checkpoint=again)
    assert 0 < again.resumed < scene.realizations
    assert all(found[name].values.tobytes() == whole[name].values.tobytes() for name in whole.variables)


@pytest.fixture(scope="module")
def transfers():
    times = torch.arange(0.0, 21.0)
    scene = tc.Scene(
        n_particles=48, n_bands=6, species=DAMPED, by_species=True, times=times, realizations=40,
        disorder=tc.Disorder(strength=0.2),
    )  # fmt: skip
    return [tc.band_transfer(dataclasses.replace(scene, seed=seed)) for seed in (0, 1)]


def test_the_transfer_explains_every_wave(transfers):
    """Waves on one species are seen in all its bands; T is what makes their mean energies later from those at the start."""
    own = transfers[0]
    options = json.loads(own.attributes["method_options"])
    found = torch.from_numpy(tc.simulate(own.scene, own.attributes["method"], options=options).band_energy.values)
    made = torch.einsum("rs,stb->rtb", found[:, 0], own.mean)
    torch.testing.assert_close(made, found, rtol=0, atol=1e-12)
    torch.testing.assert_close(own.mean[:, 0], torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-12)
    assert 1 < own.attributes["start_condition"] < 5
    off = (own.mean - transfers[1].mean)[:, 1:] / torch.hypot(own.stderr, transfers[1].stderr)[:, 1:]
    assert 0.7 < float(off.square().mean().sqrt()) < 1.3  # the errors by leaving out blocks are those between ensembles


def test_a_model_is_as_near_to_fresh_chains_as_another_ensemble(transfers, tmp_path):
    own, fresh = transfers
    own.save(tmp_path / "transfer.nc")
    read = tc.BandTransfer.load(tmp_path / "transfer.nc")
    assert read.scene.to_toml() == own.scene.to_toml()
    assert read.attributes["start_condition"] == own.attributes["start_condition"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # doubts of damped models are worded elsewhere
        master = tc.calibrate(read, bootstrap=0)
        predicted = master.solve(torch.eye(6, dtype=torch.float64), fresh.times)
    two = float(tc.total_variation(own.mean, fresh.mean)[:, 1:].mean())
    assert float(tc.total_variation(predicted, fresh.mean)[:, 1:].mean()) < 1.25 * two
    other = dataclasses.replace(own.scene, species=UNDAMPED)
    assert any("species" in words for words in master.concerns(other))


def test_kicks_outrun_no_part_of_a_fast_mixture():
    fast = (Species("light", mass=0.2, stiffness=3.0), Species("other"))
    scene = tc.Scene(
        n_particles=400, boundary="fixed", species=fast, arrangement="blocks", excitation=tc.Impulse(site=20),
        times=[0.0, 20.0], observables=("center", "total_energy"), realizations=1, disorder=tc.Disorder(strength=0.0),
    )  # fmt: skip
    found = tc.simulate(scene, "chebyshev")
    chain = scene.chain([0])
    path = tc.evolve(chain, tc.impulse(chain, site=20), scene.times, method="modes")
    center = tc.energy_center(tc.particle_energy(chain, path))[0]
    torch.testing.assert_close(torch.from_numpy(found.center.values), center, rtol=1e-8, atol=0)


def test_spheres_of_given_radius_by_the_force_law():
    """Stiffness dF/d(overlap) of F = (4/3) E* sqrt(R) overlap^(3/2) at one force, beside that of the reference contact."""

    def stiffness(moduli, radii, force=7.0):
        effective, radius = (1 / sum(1 / x for x in pair) for pair in (moduli, radii))
        law = lambda overlap: 4 / 3 * effective * radius**0.5 * overlap**1.5  # noqa: E731
        overlap = (force / law(1.0)) ** (2 / 3)
        return (law(overlap * (1 + 1e-6)) - law(overlap * (1 - 1e-6))) / (2e-6 * overlap)

    a, b = Species("a", radius=0.7, modulus=3.0, density=2.0), Species("b", radius=1.9)
    reference = stiffness((1, 1), (1, 1))
    assert a.mass == pytest.approx(2 * 0.7**3)
    for one, other in ((a, a), (a, b), (b, b)):
        known = stiffness((one.modulus, other.modulus), (one.radius, other.radius)) / reference
        assert hertz_stiffness(one, other) == pytest.approx(known, rel=1e-8)
    chain = tc.species.Mixture((a, b), "alternating", "hertz").chain(4, 1, 0)
    assert chain.contact_stiffness[0].tolist() == pytest.approx([hertz_stiffness(a, b)] * 4)
    assert a.stiffness == pytest.approx(stiffness((3, 3), (0.7, 0.7)) / reference, rel=1e-8)


FLAGS = ["--n-particles", "24", "--n-bands", "4", "--by-species", "True", "--realizations", "4", "--times.stop", "6",
         "--times.step", "1", "--species", "soft: stiffness=0.4, damping=0.05", "hard: radius=2", "--unlike", "0.7", "0.01",
         "--observables", "band_energy", "species_energy", "--arrangement", "blocks"]  # fmt: skip


def test_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["simulate", *FLAGS, "--out", "sim"]) == 0
    assert "4 periodic chains, N = 24 of soft and hard" in capsys.readouterr().out
    scene = tc.Scene.from_toml("sim/config.toml")
    assert scene.unlike == (0.7, 0.01)
    assert scene.species[1].mass == 8.0
    with xarray.open_dataset("sim/results.nc", engine="h5netcdf") as one:
        assert one.sizes["species"] == 2
        assert one.band_energy.values.tobytes() == tc.simulate(scene).band_energy.values.tobytes()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"species": ()}, "by_species must be left out without species"),
        ({"species": "soft"}, "species must be a list of species"),
        ({"species": ("soft: hardness=1",)}, "species must have only the keys name, mass"),
        ({"species": ("soft: mass=x",)}, "species must be 'NAME: FIELD=NUMBER, ...'"),
        ({"species": ("soft mass=1", "hard")}, "species must be 'NAME: FIELD=NUMBER, ...', got 'soft mass=1'"),
        ({"species": ({"mass": 1.0},)}, "species must have a name each"),
        ({"species": (Species("a", fraction=0.2), Species("b"))}, "species.fraction must sum up to 1"),
        ({"arrangement": "stacked"}, "arrangement must be one of"),
        ({"unlike": ("1", "x")}, "unlike stiffness must be"),
        ({"unlike": "hertz"}, "species.radius must be given"),
        ({"damping": 0.1}, "damping must be that of the species"),
        ({"opposite_pairs": True}, "opposite_pairs must be left out for a mixture"),
        ({"n_bands": 5}, "n_bands must be a multiple of the 2 species"),
        ({"boundary": "fixed"}, "boundary must be 'periodic' for by_species"),
        ({"contact": "hertz"}, "contact must be 'linear' for by_species"),
        ({"observables": ("long_time_band_energy",)}, "by_species must be False"),
        ({"lattice": "square", "shape": (4, 6)}, "species must be left out for a lattice"),
    ],
)
def test_bad_scenes_are_one_line(changes, message):
    fields = {name: getattr(SCENE, name) for name in ("n_particles", "n_bands", "times", "species", "by_species")}
    with pytest.raises((tc.FieldError, tc.FieldTypeError)) as caught:
        tc.Scene(**{**fields, **changes})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_mixtures_cannot_is_told():
    pair = tc.Scene(
        n_particles=16, n_bands=4, species=UNDAMPED, by_species=True, arrangement="alternating", times=[0, 1]
    )
    with pytest.raises(tc.FieldError, match="arrangement must tell k from pi - k"):
        tc.band_transfer(pair)
    with pytest.raises(tc.FieldError, match="species must be left out for method 'theory'"):
        tc.band_transfer(SCENE, "theory")
    with pytest.raises(tc.FieldError, match="times must begin at 0"):
        tc.band_transfer(dataclasses.replace(SCENE, times=[1.0, 2.0]))
    with pytest.raises(tc.FieldError, match=r"species.mass must be left out with a radius, which makes it 8"):
        Species("large", mass=2.0, radius=2.0)
    with pytest.raises(tc.FieldError, match=r"species.modulus must be left out without a radius"):
        Species("large", modulus=2.0)
