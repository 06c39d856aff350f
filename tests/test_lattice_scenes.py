"""Scenes of lattices: ensembles, error bars, checkpoints, ranks, transfers, models and commands as for chains."""

import json
import warnings
from dataclasses import replace

import pytest
import torch
import xarray
from test_ranks import Lost

import torchchain as tc
from torchchain import cli
from torchchain import network as nw
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.measured_transfer import measured_observables

TIMES = [0.0, 0.5, 3.0, 12.0]
SCENE = tc.Scene(
    lattice="triangular", shape=(9, 8), n_bands=6, times=TIMES, realizations=8, seed=5, disorder=tc.Disorder(strength=0.3)
)  # fmt: skip
DISORDERS = {
    "masses": {},
    "two kinds of masses": {"disorder": tc.Disorder(kind="binary", strength=0.4)},
    "stiffness": {"disorder": tc.Disorder(strength=0.0), "stiffness_disorder": tc.Disorder(strength=0.3)},
    "missing bonds": {"removed_bonds": 0.1},
    "moved particles": {"position_disorder": 0.05},
    "all at once": {"stiffness_disorder": tc.Disorder(strength=0.2), "removed_bonds": 0.05, "position_disorder": 0.03},
}
pytestmark = pytest.mark.filterwarnings("ignore::torchchain.network.FloppyWarning")


def by_hand(scene, i):
    """Lattice i of the scene, from the functions for single networks."""
    network = nw.disordered(
        nw.lattice(scene.lattice, scene.shape), scene.disorder, scene.stiffness_disorder, [i], scene.seed
    )
    if scene.removed_bonds:
        kept = nw.diluted(nw.lattice(scene.lattice, scene.shape), scene.removed_bonds, [i], scene.seed).stiffness
        network = replace(network, stiffness=network.bond_stiffness * kept)
    return nw.displaced(network, scene.position_disorder, i, scene.seed) if scene.position_disorder else network


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
@pytest.mark.parametrize("disorder", list(DISORDERS))
def test_an_ensemble_is_the_mean_over_its_lattices(disorder, method):
    scene = replace(SCENE, **DISORDERS[disorder])
    found = tc.simulate(scene, method)
    each = []
    for i in range(scene.realizations):
        network = by_hand(scene, i)
        waves = nw.band_waves(network, scene.n_bands).state
        path = nw.evolve(network, waves, scene.times)
        each.append(nw.band_energy(network, path, scene.n_bands)[0])
    shares = torch.stack(each)
    mean, stderr = shares.mean(0), shares.std(0) / len(each) ** 0.5
    torch.testing.assert_close(torch.from_numpy(found.band_energy.values), mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.from_numpy(found.band_energy_stderr.values), stderr, rtol=0, atol=1e-9)
    assert stderr[:, 1:].max() > 1e-3


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
def test_a_kick_in_space(method):
    names = ("energy", "radial_profile", "radius", "spread", "front", "source_energy", "total_energy")
    scene = replace(SCENE, excitation=tc.Impulse(site=30), observables=names)
    found = tc.simulate(scene, method)
    energy = torch.from_numpy(found.energy.values)
    total = torch.from_numpy(found.total_energy.values)
    away = nw.distances(nw.lattice("triangular", scene.shape), 30)
    torch.testing.assert_close(energy.sum(-1), total, rtol=1e-10, atol=0)
    torch.testing.assert_close(torch.from_numpy(found.radial_profile.values).sum(-1), total, rtol=1e-10, atol=0)
    torch.testing.assert_close(torch.from_numpy(found.source_energy.values), energy[:, 29], rtol=1e-10, atol=0)
    spread = torch.stack(
        [
            nw.energy_spread(network, nw.particle_energy(network, nw.evolve(network, scene.state(network), TIMES)), 30)[
                0
            ]
            for network in (scene.system([i]) for i in range(scene.realizations))
        ]
    ).mean(0)
    torch.testing.assert_close(torch.from_numpy(found.spread.values), spread, rtol=1e-8, atol=1e-12)
    assert found.radius.values[1:].max() < away.max()
    assert (found.front.diff("time") >= 0).all()  # no ring has gone round and come back so soon


@pytest.mark.parametrize("disorder", ["masses", "moved particles"])
def test_ranks_and_checkpoints_change_no_bit(disorder, tmp_path):
    scene = replace(SCENE, **DISORDERS[disorder])
    whole = tc.simulate(scene, "chebyshev")
    for rank in range(2):
        with pytest.raises(RuntimeError, match="has ended"):
            tc.simulate(scene, "chebyshev", checkpoint=Checkpoint(tmp_path, 0), ranks=Lost(rank, 3))
    again = Checkpoint(tmp_path, 0)
    found = tc.simulate(scene, "chebyshev", checkpoint=again)
    assert 0 < again.resumed < scene.realizations
    assert all(found[name].values.tobytes() == whole[name].values.tobytes() for name in whole.variables)


@pytest.mark.parametrize("strength", [0.1, 0.4])
def test_a_model_is_as_near_to_fresh_lattices_as_another_ensemble(strength):
    times = [*torch.arange(0, 5, 0.5).tolist(), *range(5, 21)]
    own, fresh = (
        tc.band_transfer(
            tc.Scene(
                lattice="triangular", shape=(12, 12), n_bands=6, times=times, realizations=24, seed=seed,
                disorder=tc.Disorder(strength=strength),
            )
        )
        for seed in (0, 1)
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # doubts are worded elsewhere
        master = tc.calibrate(own, bootstrap=0)
        predicted = master.solve(torch.eye(6, dtype=torch.float64), fresh.times)
    two = float(tc.total_variation(own.mean, fresh.mean)[:, 1:].mean())
    assert float(tc.total_variation(predicted, fresh.mean)[:, 1:].mean()) < 1.25 * two
    assert (
        float(tc.total_variation(predicted[:, -1:], predicted[:, :1]).mean()) > 10 * two
    )  # there was something to model


def test_plans_weigh_the_methods_of_networks_and_keep_their_promise():
    plan = tc.plan(replace(SCENE, tolerance=1e-6))
    assert plan.method in nw.METHODS
    exact, found = tc.simulate(SCENE, "modes"), tc.simulate(replace(SCENE, tolerance=1e-6))
    assert float(abs(exact.band_energy - found.band_energy).max()) < plan.predicted_error <= 1e-6
    damped = tc.plan(replace(SCENE, damping=0.05))
    assert nw.METHODS[damped.method].damped


def test_damping_takes_what_the_bands_lose():
    scene = replace(SCENE, damping=0.02, observables=("band_energy", "dissipated", "total_energy"), realizations=1)
    exact, stepped = tc.simulate(scene, "damped"), tc.simulate(scene, "verlet", options={"step": 0.004})
    for name in scene.observables:
        # Phases err by w^3 step^2 t / 24, 1e-4 for the shortest waves.
        assert abs(exact[name] - stepped[name]).max() < 1e-4 * max(1.0, float(exact[name].max()))
    left = exact.total_energy.values / exact.total_energy.values[..., :1]
    assert abs(exact.band_energy.sum("band").values - left).max() < 1e-3  # means of ratios beside a ratio of means
    assert left[..., -1].max() < 0.95  # the longest waves are damped least


def test_large_lattices_take_no_modes():
    large = replace(SCENE, shape=(28, 28), n_particles=None)
    assert measured_observables(SCENE) == ("band_energy", "long_time_band_energy")
    assert measured_observables(large) == measured_observables(replace(SCENE, damping=0.1)) == ("band_energy",)
    found = tc.band_transfer(replace(large, realizations=2, times=[0.0, 2.0, 4.0]), "chebyshev")
    late = found.times >= 2
    torch.testing.assert_close(found.long_time, found.mean[:, late].mean(1), rtol=0, atol=1e-12)


FLAGS = "--lattice triangular --shape 8 8 --n-bands 6 --realizations 6 --times.stop 6 --disorder.strength 0.2".split()


def test_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["simulate", *FLAGS, "--out", "sim"]) == 0
    assert "6 periodic triangular lattices, 8 x 8, vector, xi = 0.2, 6 plane waves" in capsys.readouterr().out
    with xarray.open_dataset("sim/results.nc", engine="h5netcdf") as data:
        assert data.sizes["band"] == 6
    assert cli.main(["calibrate", *FLAGS, "--bootstrap", "0", "--out", "cal"]) == 0
    record = json.loads((tmp_path / "cal" / "run.json").read_text())
    assert record["forecast"]["predicted_seconds"] > 0
    assert cli.main(["predict", "cal/model.safetensors", "--out", "pre"]) == 0
    assert cli.main(["simulate", "--config", "sim/config.toml", "--out", "again"]) == 0
    with (
        xarray.open_dataset("sim/results.nc", engine="h5netcdf") as one,
        xarray.open_dataset("again/results.nc", engine="h5netcdf") as two,
    ):
        assert all(one[name].values.tobytes() == two[name].values.tobytes() for name in one.variables)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": None}, "shape must be given for a lattice, got None"),
        ({"lattice": None}, "shape must be left out without a lattice"),
        ({"lattice": "hexagonal"}, "lattice must be one of"),
        ({"shape": (9,)}, "shape must have 2 entries"),
        ({"shape": (2, 8)}, "shape must be at least 3 along a periodic axis"),
        ({"motion": "shear"}, "motion must be one of"),
        ({"contact": "hertz"}, "contact must be 'linear' for a lattice"),
        ({"removed_bonds": 1.0}, "removed_bonds must be less than 1"),
        ({"removed_bonds": -0.1}, "removed_bonds must be at least 0"),
        ({"position_disorder": 0.4}, "position_disorder must be at most 0.3"),
        ({"motion": "scalar", "position_disorder": 0.1}, "position_disorder must be zero for motion 'scalar'"),
        ({"n_bands": 7}, "n_bands must"),
        ({"n_bands": 60}, "n_bands must leave a wave inside the zone for every shell"),
        ({"boundary": "fixed"}, "boundary must be 'periodic' for bands of wavevectors"),
        ({"excitation": tc.Impulse(site=73), "observables": ("energy",)}, "excitation.site must be at most 72"),
        ({"observables": ("center",)}, "observables"),
    ],
)
def test_bad_scenes_are_one_line(changes, message):
    fields = {name: getattr(SCENE, name) for name in ("lattice", "shape", "n_bands", "times", "realizations")}
    with pytest.raises((tc.FieldError, TypeError)) as caught:
        tc.Scene(**{**fields, **changes})
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
