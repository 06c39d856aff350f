"""Memory is estimated before it is taken."""

import pytest
import torch
from taken import LITTLE, Taken

import torchchain as tc
from torchchain import cli
from torchchain.checks import FieldError
from torchchain.ensemble import footprint

LONG = torch.arange(10**7, dtype=torch.float64) / 1e6


@pytest.fixture(autouse=True)
def sixteen_gigabytes(monkeypatch):
    monkeypatch.setattr(footprint, "memory", lambda device: 16 * 10**9)


@pytest.mark.parametrize(
    ("fields", "method", "message"),
    [
        (
            {"n_particles": 10**8},
            "modes",
            "n_particles must need at most the 16 GB of memory of this machine, got 100000000",
        ),
        ({"n_particles": 10**5, "n_bands": 1}, "modes", r"n_particles must need .*, got 100000: about 640 GB"),
        ({"n_particles": 10**8}, "auto", "n_particles must need"),
        (
            {"times": LONG, "observables": ("energy",), "n_bands": 1},
            "chebyshev",
            r"observables must take at most the 16 GB of memory of this machine, got energy at 10000000 times of 256",
        ),
        ({"times": LONG, "observables": ("energy",), "n_bands": 1}, "auto", "observables must take at most"),
        (
            {"n_particles": 10**5, "n_bands": 1, "observables": ("long_time_band_energy",)},
            "chebyshev",
            "n_particles must need",
        ),
        (
            {"n_particles": 2 * 10**4, "n_bands": 1, "damping": 0.1, "observables": ("center",)},
            "damped",
            "n_particles must",
        ),
    ],
)
def test_what_cannot_fit_is_refused_at_once(fields, method, message):
    with Taken() as taken, pytest.raises(FieldError, match=message):
        tc.simulate(tc.Scene(**fields), method)
    assert taken.largest < LITTLE  # nothing was drawn or computed


def test_transfers_and_the_command(tmp_path, capsys):
    with pytest.raises(FieldError, match="n_particles must need at most the 16 GB"):
        tc.band_transfer(tc.Scene(n_particles=10**8), "modes")
    out = tmp_path / "out"
    assert cli.main(["calibrate", "--n-particles", "100000000", "--method", "modes", "--out", str(out)]) == 2
    errors = capsys.readouterr().err
    assert errors.startswith(
        "torchchain: error: n_particles must need at most the 16 GB of memory of this machine, got"
    )
    assert errors.count("\n") == 1
    assert not out.exists()


def test_what_fits_is_not_refused():
    assert "center" in tc.simulate(
        tc.Scene(
            n_particles=10**5,
            n_bands=1,
            times=[0.0, 10.0],
            realizations=1,
            excitation=tc.Impulse(5),
            observables=("center",),
        ),
        "chebyshev",
    )


def test_an_estimate_is_what_the_tensors_hold():
    names = ("band_energy", "energy", "center", "wavenumber_energy")
    scene = tc.Scene(n_particles=32, n_bands=4, realizations=3, times=[0.0, 1.0, 2.0], observables=names)
    one = footprint.footprint(scene, "modes", False)
    found = tc.simulate(
        tc.Scene(n_particles=32, n_bands=4, realizations=1, times=[0.0, 1.0, 2.0], observables=names), "modes"
    )
    assert one.results == sum(found[name].nbytes for name in names)
    chain = scene.chain([0])
    assert one.matrices >= 4 * tc.normal_modes(chain).shapes.nbytes
    assert one.state >= 4 * scene.state(chain).displacement.nbytes


def test_this_machine_has_memory(monkeypatch):
    monkeypatch.undo()
    assert 2**28 < footprint.memory(torch.device("cpu")) < 2**50
