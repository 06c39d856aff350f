"""Observables of one's own go wherever the library's go."""

import warnings

import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain import cli
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble import footprint
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.moving_part import moving_part
from torchchain.ensemble.observables import OBSERVABLES, Observable


def peak(scene, chain, trajectory):
    return trajectory.displacement.abs().amax(-1)


def speeds(scene, chain, trajectory):
    return trajectory.velocity


def place(scene, chain, trajectory):
    return 1 + trajectory.velocity.abs().argmax(-1).to(trajectory.velocity)


OWN = (
    Observable("peak", ("time",), "initial overlap", "largest displacement", peak, local=True),
    Observable("speeds", ("time", "particle"), "sound speed", "velocity", speeds, local=True),
    Observable("place", ("time",), "particle", "fastest particle", place, local=True, is_place=True),
)


@pytest.fixture
def registered():
    for entry in OWN:
        tc.register_observable(entry)
    yield
    for entry in OWN:
        del OBSERVABLES[entry.name]


def scene(**fields):
    given = {
        "n_particles": 400, "boundary": "fixed", "excitation": tc.Impulse(200), "times": [0.0, 3.0, 9.0], "realizations": 5,
        "observables": ("peak", "speeds", "place"),
    }  # fmt: skip
    return tc.Scene(**{**given, **fields})


@pytest.mark.usefixtures("registered")
@pytest.mark.parametrize("method", ["auto", "chebyshev"])
def test_own_observables_are_measured_on_the_part_that_moves(method, tmp_path):
    wanted = scene()
    assert moving_part(wanted) is not None
    data = tc.simulate(wanted, method, checkpoint=Checkpoint(tmp_path, 0))
    chain = wanted.chain(range(5))
    exact = tc.evolve(chain, wanted.state(chain), wanted.times)
    allowed = tc.plan(wanted).tolerance if method == "auto" else 3e-5  # what the plan promises, or the cut's own error
    for entry in OWN:
        expected = entry.compute(wanted, chain, exact).mean(0).numpy()
        np.testing.assert_allclose(data[entry.name].values, expected, rtol=0, atol=allowed * abs(expected).max())
    assert data["speeds"].dims == ("time", "particle")
    assert data["peak"].attrs == {"units": "initial overlap", "long_name": "largest displacement"}
    again = Checkpoint(tmp_path, 0)
    assert tc.simulate(wanted, method, checkpoint=again).identical(data)
    assert again.resumed == 5


@pytest.mark.usefixtures("registered")
def test_the_plan_the_memory_and_the_command_know_them(tmp_path):
    assert tc.plan(scene(tolerance=1e-3)).predicted_seconds > 0
    assert footprint.footprint(scene(), "modes", False).results == 8 * (3 + 3 * 400 + 3)
    flags = "--n-particles 64 --realizations 2 --times.stop 2 --excitation.kind impulse --observables peak".split()
    assert cli.main(["simulate", *flags, "--out", str(tmp_path / "out")]) == 0
    with xarray.open_dataset(tmp_path / "out" / "results.nc", engine="h5netcdf") as data:
        assert data["peak"].attrs["long_name"] == "largest displacement"
        assert float(data["peak_stderr"].max()) > 0


def test_names_are_taken_once_and_records_are_checked():
    with pytest.raises(FieldError, match="observable.name must not be taken, got 'energy'"):
        tc.register_observable(OBSERVABLES["energy"])
    with pytest.raises(FieldError, match="observable.axes must be one of time, particle"):
        Observable("x", ("time", "site"), "1", "x", peak)
    with pytest.raises(FieldError, match="observable.axes must start with 'time'"):
        Observable("x", ("particle",), "1", "x", peak)
    with pytest.raises(FieldError, match="observable must have either compute or average"):
        Observable("x", ("time",), "1", "x")
    with pytest.raises(FieldError, match=r"observable.name must be a name that does not end in _stderr"):
        Observable("energy_stderr", ("time",), "1", "x", peak)
    with pytest.raises(FieldError, match="observable.name must be no axis of the results, got 'time'"):
        Observable("time", ("time",), "1", "x", peak)
    with pytest.raises(FieldTypeError, match="observable.unit must be a str, got 1"):
        Observable("x", ("time",), 1, "x", peak)
    with pytest.raises(FieldTypeError, match="observable must compute by a function, got 3"):
        Observable("x", ("time",), "1", "x", 3)
    with pytest.raises(FieldTypeError, match="observable must be an Observable, got 'peak'"):
        tc.register_observable("peak")
    with pytest.raises(FieldError, match="observables must be one of band_energy, .*, got 'peak'"):
        scene(observables=("peak",))


def test_an_observable_of_the_wrong_shape_is_named(monkeypatch):
    wrong = Observable("wrong", ("time",), "1", "x", speeds)
    monkeypatch.setitem(OBSERVABLES, "wrong", wrong)
    with pytest.raises(FieldError, match=r"observable wrong must give shape \(1, 3\), got shape \(1, 3, 16\)"):
        tc.simulate(scene(n_particles=16, excitation=tc.Impulse(8), observables=("wrong",), realizations=1), "modes")


def test_an_observable_of_complex_numbers_is_named(monkeypatch):
    monkeypatch.setitem(OBSERVABLES, "wave", Observable("wave", ("time",), "1", "x", lambda *given: 1j * peak(*given)))
    with pytest.raises(FieldError, match="observable wave must give real numbers, got torch.complex128"):
        tc.simulate(scene(n_particles=16, excitation=tc.Impulse(8), observables=("wave",), realizations=1), "modes")


def test_the_center_of_a_ring_that_energy_has_gone_round_is_remarked_upon():
    kick = {"n_particles": 32, "realizations": 2, "observables": ("center", "width"), "excitation": tc.Impulse(16)}
    with pytest.warns(tc.SeamWarning, match="center and width count the particles of a ring from 1 to 32, .* from time 15 on"):
        found = tc.simulate(tc.Scene(**kick, times=[30.0]), "modes")
    assert float(found["width"][0]) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error", tc.SeamWarning)
        tc.simulate(tc.Scene(**kick, times=[15.0]), "modes")
        tc.simulate(tc.Scene(**kick, times=[30.0], boundary="fixed"), "modes")
        tc.simulate(tc.Scene(**{**kick, "observables": ("energy",)}, times=[30.0]), "modes")


def test_an_average_of_ones_own(monkeypatch):
    lowest = Observable(
        "lowest", (), "1", "lowest frequency", average=lambda scene, chain, state, modes: modes.frequencies[..., 0]
    )
    monkeypatch.setitem(OBSERVABLES, "lowest", lowest)
    wanted = scene(n_particles=16, excitation=tc.Impulse(8), observables=("lowest", "center"))
    expected = tc.normal_modes(wanted.chain(range(5))).frequencies[:, 0]
    found = tc.simulate(wanted, "chebyshev")["lowest"]
    assert found.dims == ()
    assert float(found) == pytest.approx(float(torch.as_tensor(expected).mean()), rel=1e-12)
