"""The torchchain command: what it leaves behind, and one line for everything that is wrong."""

import json
import os
import re
import subprocess
import sys
import tomllib

import numpy as np
import pytest
import torch
import xarray

import torchchain as tc
from torchchain import cli
from torchchain.cli import outputs
from torchchain.modes.spectrum import DecompositionError

SMALL = "--n-particles 32 --n-bands 4 --realizations 4 --times.stop 5 --seed 5 --method modes".split()


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """The folder of a small calibration."""
    out = tmp_path_factory.mktemp("calibrated") / "out"
    assert cli.main(["calibrate", *SMALL, "--out", str(out)]) == 0
    return out


# What a run leaves behind


@pytest.mark.usefixtures("rendered")
def test_simulate(run, tmp_path):
    names = ["band_energy", "energy", "center", "long_time_band_energy"]
    status, output, errors = run("simulate", *SMALL, "--observables", *names, "--out", "here/there")
    out = tmp_path / "here" / "there"
    assert (status, errors) == (0, "")
    assert sorted(os.listdir(out)) == ["config.toml", "figure.png", "report.html", "results.nc", "run.json"]
    assert os.listdir(tmp_path) == ["here"]
    assert os.listdir(tmp_path / "here") == ["there"]
    scene = tc.Scene.from_toml(out / "config.toml")
    with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as data:
        expected = tc.simulate(scene, "modes")
        for name in expected.data_vars:
            np.testing.assert_array_equal(data[name].values, expected[name].values)
            assert data[name].attrs["units"] == expected[name].attrs["units"]
        assert data["time"].attrs["units"]
    record = json.loads((out / "run.json").read_text())
    assert record["arguments"][0] == "simulate"
    assert record["seed"] == 5
    assert record["device"] == "cpu"
    assert {"torch", "numpy", "torchchain"} <= set(record["versions"])
    assert record["realized"]["mass_mean"] == pytest.approx(scene.disorder.masses(32, 4, 5).mean().item(), rel=1e-12)
    assert (out / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert "4 periodic chains, N = 32, xi = 0.3" in output


@pytest.mark.parametrize(
    "arguments",
    [
        ["--observables", "displacement", "source_energy", "total_energy", "wavenumber_energy", "width"],
        ["--observables", "energy", "center", "--excitation.kind", "impulse", "--boundary", "fixed"],
        ["--observables", "band_energy", "center", "--times.stop", "0"],
        ["--disorder.strength", "0", "--realizations", "1000000"],
        ["--realizations", "1", "--n-bands", "1"],
        ["--n-particles", "2", "--n-bands", "1", "--excitation.phase", "cos", "--observables", "band_energy", "width"],
    ],
)
def test_corners_of_simulate(run, arguments):
    status, _, errors = run("simulate", *SMALL, *arguments, "--out", "out")
    assert (status, errors) == (0, "")
    with xarray.open_dataset("out/results.nc", engine="h5netcdf") as data:
        for name in data.data_vars:
            assert not np.isnan(data[name].values).any()


def test_calibrate(calibrated):
    assert sorted(os.listdir(calibrated)) == [
        "config.toml", "figure.png", "model.safetensors", "report.html", "run.json", "transfer.nc",
    ]  # fmt: skip
    master = tc.MasterEquation.load(calibrated / "model.safetensors")
    with xarray.open_dataset(calibrated / "transfer.nc", engine="h5netcdf") as data:
        transfer = tc.BandTransfer.from_dataset(data)
        predicted = master.solve(torch.eye(4, dtype=torch.float64), transfer.times)
        np.testing.assert_array_equal(tc.open(calibrated).prediction.values, predicted.detach().numpy())
    again = tc.calibrate(transfer)
    assert torch.equal(again.basis, master.basis)
    assert again.calibration.report == master.calibration.report
    record = json.loads((calibrated / "run.json").read_text())
    assert record["summary"]["conservation defect"] < 1e-12


@pytest.mark.parametrize(
    ("arguments", "drawn"),
    [
        (["--fit", "linear", "--window", "1", "2"], False),
        (["--fit", "nonlinear", "--model", "paper"], False),
        (["--fit", "analytic"], False),
        (["--fit", "adam", "--constraint", "penalty", "--penalty", "1", "--model", "paper"], False),
        (["--disorder.strength", "0"], False),
        (["--disorder.strength", "0", "--times.stop", "0"], True),
        (["--realizations", "1"], True),
        (["--energy-definition", "bond"], False),
        (["--boundary", "fixed"], False),
        (["--n-bands", "1"], True),
    ],
)
def test_corners_of_calibrate(run, arguments, drawn, request):
    if drawn:
        request.getfixturevalue("rendered")
    status, output, errors = run("calibrate", *SMALL, "--realizations", "3", *arguments, "--out", "out")
    assert (status, errors) == (0, "")
    assert "nan" not in output
    summary = json.loads(open("out/run.json").read(), parse_constant=pytest.fail)["summary"]
    assert all(value == value for value in summary.values())  # no NaN
    run("predict", "out/model.safetensors", "--times.stop", "9", "--out", "next")
    with xarray.open_dataset("next/results.nc", engine="h5netcdf") as data:
        assert np.isfinite(data["band_energy"].values).all()


@pytest.mark.parametrize("command", ["simulate", "calibrate"])
def test_the_resolved_config_makes_the_run_again(run, command):
    flags = {"simulate": [], "calibrate": ["--fit", "linear", "--window", "0.5", "3"]}[command]
    results = {"simulate": "results.nc", "calibrate": "transfer.nc"}[command]
    assert run(command, *SMALL, *flags, "--out", "first")[0] == 0
    assert run(command, "--config", "first/config.toml", "--method", "modes", "--out", "second")[0] == 0
    with (
        xarray.open_dataset(f"first/{results}", engine="h5netcdf") as first,
        xarray.open_dataset(f"second/{results}", engine="h5netcdf") as second,
    ):
        assert first.identical(second)
    assert open("first/config.toml").read() == open("second/config.toml").read()
    if command == "calibrate":
        assert open("first/model.safetensors", "rb").read() == open("second/model.safetensors", "rb").read()


def test_predict(run, calibrated):
    model = calibrated / "model.safetensors"
    master = tc.MasterEquation.load(model)
    status, output, errors = run("predict", model, "--source", "2", "4", "--times.stop", "3", "--times.step", "1.5")
    assert (status, errors) == (0, "")
    with xarray.open_dataset("results/predict/results.nc", engine="h5netcdf") as data:
        assert data["time"].values.tolist() == [0, 1.5, 3]
        assert data["start"].values.tolist() == ["2", "4"]
        expected = master.solve(np.eye(4)[[1, 3]], [0, 1.5, 3]).detach().numpy()
        np.testing.assert_array_equal(data["band_energy"].values, expected)
    assert "2 starts, 3 times to 3, solved by expm" in output


def test_a_folder_stands_for_its_model(run, calibrated):
    assert tc.MasterEquation.load(calibrated).n_bands == 4
    status, output, errors = run("plan", *SMALL[:-2], "--artifact", calibrated)
    assert (status, errors) == (0, "")
    assert "the master equation at hand" in output
    status, output, _ = run("predict", calibrated, "--source", "2", "--times.stop", "3")
    assert status == 0
    assert "1 start, 13 times to 3" in output


def test_a_folder_of_an_input_is_not_written_over(run):
    assert run("calibrate", *SMALL, "--model", "memory", "--bootstrap", "0", "--out", "model")[0] == 0
    before = open("model/run.json").read()
    for command in (
        ["predict", "model"], ["predict", "model/model.safetensors"], ["family", "model"], ["compare", "model", "model"],
        ["calibrate", "--transfer", "model"],
    ):  # fmt: skip
        assert "out must be another folder than that of the input" in complains(run(*command, "--out", "./model"))
    assert open("model/run.json").read() == before


def test_predict_from_any_start_by_any_solver(run):
    # of a model that is a differential equation: others solve that of the nearest one with memory
    assert run("calibrate", *SMALL, "--realizations", "40", "--model", "memory", "--out", "memory")[0] == 0
    model = "memory/model.safetensors"
    assert run("predict", model, "--initial", "0.1", "2", "0", "0", "--method", "dopri8", "--out", "out")[0] == 0
    expected = tc.MasterEquation.load(model).solve([0.1, 2, 0, 0], np.arange(201) / 4).detach().numpy()
    with xarray.open_dataset("out/results.nc", engine="h5netcdf") as data:
        np.testing.assert_allclose(data["band_energy"].values[0], expected, atol=1e-8)
    # and again from the request it left
    assert run("predict", model, "--config", "out/config.toml", "--method", "dopri8", "--out", "again")[0] == 0
    with (
        xarray.open_dataset("out/results.nc", engine="h5netcdf") as first,
        xarray.open_dataset("again/results.nc", engine="h5netcdf") as second,
    ):
        assert first.identical(second)


def test_flags_override_the_file_and_the_file_the_defaults(run, tmp_path):
    (tmp_path / "scene.toml").write_text(
        "n_particles = 16\nn_bands = 4\nrealizations = 2\nseed = 9\n"
        "[disorder]\nstrength = 0.1\nkind = 'uniform'\n[times]\nstop = 2\nstep = 0.5\n"
        "[excitation]\nkind = 'impulse'\nsite = 3\n"
    )
    flags = "--seed 4 --disorder.strength 0.2 --times.step 1 --method modes --out out".split()
    assert run("simulate", "--config", "scene.toml", *flags)[0] == 0
    scene = tomllib.load(open("out/config.toml", "rb"))
    assert (scene["n_particles"], scene["seed"], scene["boundary"]) == (16, 4, "periodic")
    assert scene["disorder"] == {"kind": "uniform", "strength": 0.2, "lower": 0.05}
    assert scene["times"] == {"start": 0.0, "stop": 2.0, "step": 1.0}
    assert scene["excitation"] == {"kind": "impulse", "site": 3, "velocity": 0.01}
    # another kind of excitation replaces the file's, with its fields
    assert run("simulate", "--config", "scene.toml", "--excitation.kind", "standing_wave", *flags)[0] == 0
    assert tomllib.load(open("out/config.toml", "rb"))["excitation"]["kind"] == "standing_wave"


def test_flags_of_times_fill_up_a_list_in_the_file(run, tmp_path):
    (tmp_path / "scene.toml").write_text("times = [0.0, 7.0]\nn_particles = 16\nn_bands = 4\nrealizations = 1")
    assert run("simulate", "--config", "scene.toml", "--times.stop", "1", "--method", "modes", "--out", "out")[0] == 0
    assert tomllib.load(open("out/config.toml", "rb"))["times"] == {"start": 0.0, "stop": 1.0, "step": 0.25}


def test_a_second_run_replaces_the_first(run, tmp_path):
    assert run("simulate", *SMALL, "--out", "out")[0] == 0
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert run("simulate", *SMALL, "--seed", "6", "--out", "out")[0] == 0
    assert tomllib.load(open("out/config.toml", "rb"))["seed"] == 6
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    assert os.listdir(tmp_path) == ["out"]


def test_seeds_matter(run):
    for seed in ("1", "2"):
        assert run("simulate", *SMALL, "--seed", seed, "--out", seed)[0] == 0
    with (
        xarray.open_dataset("1/results.nc", engine="h5netcdf") as first,
        xarray.open_dataset("2/results.nc", engine="h5netcdf") as second,
    ):
        assert not np.array_equal(first["band_energy"].values, second["band_energy"].values)


def test_plan(run):
    status, output, errors = run("plan", "--n-particles", "32", "--n-bands", "4")
    assert (status, errors) == (0, "")
    assert "method" in output
    words = re.search("a calibration measures other starts as well: (.+) s more predicted", output)
    assert words is not None
    assert float(words[1]) > 0
    _, output, _ = run("plan", "--n-particles", "32", "--n-bands", "4", "--damping", "0.1")
    assert "other starts" not in output


# What goes wrong


def complains(result, status=2):
    """One line on standard error, nothing else, nothing left behind."""
    code, output, errors = result
    assert code == status
    assert errors.startswith("torchchain: error: ")
    assert errors.count("\n") == 1
    assert errors.endswith("\n")
    assert "Traceback" not in errors + output
    assert output == ""
    assert not os.path.exists("out")
    assert not [name for name in os.listdir(".") if name.endswith(".part")]
    return errors


FLAGS = [
    ("--n-particles x", "--n-particles must be INT, got 'x'"),
    ("--n-particles 1", "n_particles must be at least 2, got 1"),
    ("--n-particles -4", "n_particles must be at least 2, got -4"),
    ("--n-particles 33", "n_particles must be even for wavenumber bands, got 33"),
    ("--n-particles 16.0", "--n-particles must be INT, got '16.0'"),
    ("--n-particles 99999999999999999999", "n_particles must be at most 100000000"),
    ("--n-particles", "--n-particles"),
    ("--n-partcles 3", "--n-partcles"),
    ("--boundary open", "boundary must be one of periodic, fixed, got 'open'"),
    ("--disorder.kind cauchy", "disorder.kind must be one of normal, uniform, binary, lognormal, gamma, got 'cauchy'"),
    ("--disorder.strength nan", "disorder.strength must be finite, got nan"),
    ("--disorder.strength -1", "disorder.strength must be at least 0, got -1"),
    ("--disorder.strength 1e400", "disorder.strength must be finite, got inf"),
    ("--disorder.strength 1e308", "disorder.strength must be at most 10"),
    ("--disorder.strength x", "--disorder.strength must be FLOAT, got 'x'"),
    ("--disorder.lower 1", "disorder.lower must be less than 1"),
    ("--disorder.lower -0.1", "disorder.lower must be at least 0"),
    ("--disorder.kind binary --disorder.strength 0.99", "disorder.strength must be less than 1 - lower"),
    ("--excitation.kind kick", "excitation.kind must be one of impulse, standing_wave, got 'kick'"),
    ("--excitation.site 3", "excitation.kind must be 'impulse' for excitation.site, got 'standing_wave'"),
    (
        "--excitation.kind impulse --excitation.tones 1",
        "excitation.kind must be 'standing_wave' for excitation.tones, got 'impulse'",
    ),
    ("--excitation.kind impulse --excitation.site 0", "excitation.site must be at least 1, got 0"),
    ("--excitation.kind impulse --excitation.site 33", "excitation.site must be at most 32, got 33"),
    ("--excitation.kind impulse --excitation.site 1.5", "--excitation.site must be INT, got '1.5'"),
    (
        "--excitation.kind impulse --excitation.velocity 0",
        "excitation.velocity must have a size between 1e-60 and 1e60",
    ),
    ("--excitation.kind impulse --excitation.velocity 1e200", "excitation.velocity must have a size between"),
    ("--excitation.kind impulse --excitation.velocity inf", "excitation.velocity must be finite, got inf"),
    ("--excitation.tones 0", "excitation.tones must be at least 1, got 0"),
    ("--excitation.tones 16", "excitation.tones must be less than n_particles/2 = 16 for phase 'sin'"),
    ("--excitation.tones 17 --excitation.phase cos", "excitation.tones must be at most 16, got 17"),
    ("--excitation.tones 1 1", "excitation.tones must be different, got (1, 1)"),
    ("--excitation.tones 1 x", "--excitation.tones must be"),
    ("--excitation.tones", "excitation.tones must be a list of integers"),
    ("--excitation.amplitude 0", "excitation.amplitude must have a size between"),
    ("--excitation.amplitude nan", "excitation.amplitude must be finite"),
    ("--excitation.phase tan", "excitation.phase must be one of sin, cos, got 'tan'"),
    ("--times.start -1", "times.start must be at least 0"),
    ("--times.start 9", "times.stop must be at least 9"),
    ("--times.stop -1", "times.stop must be at least 0"),
    ("--times.stop inf", "times.stop must be finite"),
    ("--times.stop 1e300 --times.step 1e299", "times must be at most 1e+12"),
    ("--times.stop 1e300", "times.step must give fewer than 10000000 times"),
    ("--times.step 0", "times.step must be greater than 0"),
    ("--times.step nan", "times.step must be finite"),
    ("--times.step 1e-300", "times.step must give fewer than 10000000 times, got 1e-300"),
    ("--times.step x", "--times.step must be FLOAT, got 'x'"),
    ("--n-bands 0", "n_bands must be at least 1"),
    ("--n-bands 3", "n_bands must divide the number of tones n_particles/2 = 16, got 3"),
    ("--n-bands 17", "n_bands must be at most the number of tones n_particles/2 = 16, got 17"),
    ("--n-bands 16", "excitation.tones must be less than n_particles/2 = 16"),
    ("--n-bands x", "--n-bands must be INT, got 'x'"),
    ("--realizations 0", "realizations must be at least 1"),
    ("--realizations 1.5", "--realizations must be INT, got '1.5'"),
    ("--realizations 99999999999", "realizations must be at most 1000000000"),
    ("--seed -1", "seed must be at least 0"),
    ("--seed 18446744073709551616", "seed must be at most 18446744073709551615"),
    ("--seed now", "--seed must be INT, got 'now'"),
    ("--tolerance 0", "tolerance must be greater than 0"),
    ("--tolerance 1", "tolerance must be less than 1"),
    ("--tolerance nan", "tolerance must be finite"),
    ("--observables enrgy", "observables must be one of band_energy, "),
    ("--observables", "observables must be a list of names"),
    ("--observables energy energy", "observables must be different"),
    ("--contact glue", "contact must be one of linear, hertz, auto, got 'glue'"),
    ("--contact hertz", "contact must be 'linear' for the observable band_energy"),
    ("--contact hertz --observables energy", "contact must be linear for method 'modes'"),
    ("--damping -1", "damping must be at least 0"),
    ("--damping nan", "damping must be finite"),
    ("--damping 0.1", "damping must be zero"),
    ("--energy-definition both", "energy_definition must be one of site, bond, got 'both'"),
    ("--energy-definition bond --boundary fixed", "boundary must be 'periodic' for the observable band_energy"),
    ("--device tpu", "device must be available here, got 'tpu'"),
    ("--device meta", "device must be cpu, cuda or cuda:<number>, got 'meta'"),
    ("--device cuda:99", "device must be available here, got 'cuda:99'"),
    ("--device cpu:-1", "device must be available here, got 'cpu:-1'"),
    ("--method magic", "method must be one of auto, modes, "),
    ("--method tridiagonal", "boundary must be fixed for method 'tridiagonal', got 'periodic'"),
    ("--config nothing.toml", "config nothing.toml must be a readable file, got No such file or directory"),
    ("--config .", "config . must be a readable file, got Is a directory"),
    ("extra", "extra"),
]


@pytest.mark.parametrize(("flags", "message"), FLAGS, ids=[flags for flags, _ in FLAGS])
def test_bad_flags(flags, message, run):
    assert message in complains(run("simulate", *SMALL, *flags.split(), "--out", "out"))


def test_nan_devices_and_empty_words(run):
    assert "device must be available here, got ''" in complains(run("simulate", *SMALL, "--device", "", "--out", "out"))
    assert "boundary must be one of" in complains(run("simulate", *SMALL, "--boundary", "", "--out", "out"))
    assert "config" in complains(run("simulate", *SMALL, "--config", "", "--out", "out"))
    assert "seed" in complains(run("simulate", *SMALL, "--seed", "", "--out", "out"))


CALIBRATE_FLAGS = [
    (
        "--fit magic",
        "method must be one of analytic, linear, nonlinear, adam, projection, derivation, correction, ringing, logistic, got 'magic'",
    ),
    (
        "--model magic",
        "model must be one of paper, exact_psi, basis_matrix, swing_in, memory, theory, corrected_theory, ringing_theory, compact, got 'magic'",
    ),
    (
        "--fit linear --model memory",
        "model must be one of paper, exact_psi, basis_matrix, swing_in for method 'linear'",
    ),
    ("--fit projection --model paper", "model must be one of memory for method 'projection'"),
    ("--window 1", "--window must be"),
    ("--window 2 1", "window must be greater than 2, got 1"),
    ("--window nan 1", "window must be finite"),
    ("--window 10 20", "window must hold at least 2 of the transfer's times, got 0 in (10.0, 20.0)"),
    ("--fit nonlinear --window 1 1.5", "window must hold at least 4 of the transfer's times, got 3"),
    ("--fit adam --constraint none", "constraint must be one of exact, penalty"),
    ("--fit adam --penalty -1", "penalty must be at least 0"),
    ("--fit adam --penalty x", "--penalty must be FLOAT, got 'x'"),
    ("--fit linear --penalty 3", "settings of method 'linear' must have only the keys (none), got 'penalty'"),
    ("--excitation.kind impulse", "excitation must be standing waves for a band transfer, got Impulse"),
    ("--excitation.tones 1 5", "excitation.tones must lie one in each of the 4 bands"),
    ("--n-bands 5", "n_bands must divide"),
    ("--damping 0.1", "damping must be zero"),
    ("--contact hertz", "contact must be 'linear'"),
    ("--method magic", "method must be one of auto, modes"),
]


@pytest.mark.parametrize(("flags", "message"), CALIBRATE_FLAGS, ids=[flags for flags, _ in CALIBRATE_FLAGS])
def test_bad_flags_of_calibrate(flags, message, run, monkeypatch):
    if "damping" not in flags and "contact" not in flags and "excitation" not in flags:

        def computed(*arguments, **settings):
            pytest.fail("an ensemble was computed before the flags were checked")

        monkeypatch.setattr("torchchain.cli.calibrate.band_transfer", computed)
    assert message in complains(run("calibrate", *SMALL, *flags.split(), "--out", "out"))


CALIBRATION_TABLES = [
    ("calibration = 3", "calibration must be a table, got 3"),
    ("[calibration]\nfit = 'adam'", "calibration must have only the keys method, "),
    ("[calibration]\nmethod = 3", "method must be a string"),
    ("[calibration]\nmodel = []", "model must be a string"),
    ("[calibration]\nwindow = 3", "window must be two times, got 3"),
    ("[calibration]\nwindow = ['a', 'b']", "window must be a number, got 'a'"),
    ("[calibration]\nwindow = [1, 2, 3]", "window must be two times"),
    ("[calibration]\nwindow = {begin = 1}", "window must be two times"),
    ("[calibration]\norder = 3", "order must be two integers, got 3"),
    ("[calibration]\norder = [1, 2, 3]", "order must be two integers"),
    ("[calibration]\norder = [0, 2]", "order must be at least 1"),
    ("[calibration]\norder = [9, 9]", "order must have at most 10 functions for 21 times"),
    ("[calibration]\nmethod = 'adam'\nsteps = 0", "steps must be at least 1"),
    ("[calibration]\nmethod = 'adam'\nsteps = 1.5", "steps must be an integer"),
    ("[calibration]\nmethod = 'adam'\nlearning_rate = inf", "learning_rate must be finite"),
    ("[calibration]\nmethod = 'adam'\ntolerance = 1", "tolerance must be less than 1"),
]


@pytest.mark.parametrize(("text", "message"), CALIBRATION_TABLES, ids=[text for text, _ in CALIBRATION_TABLES])
def test_bad_calibration_tables(text, message, run, tmp_path):
    (tmp_path / "scene.toml").write_text(text)
    assert message in complains(run("calibrate", *SMALL, "--config", "scene.toml", "--out", "out"))


# Every field with a wrong value is in test_scene; here only that the command says the same in one line.
CONFIGS = [
    ("n_partcles = 4", "scene must have only the keys"),
    ("[calibration]\nmethod = 'adam'", "scene must have only the keys"),
    ("n_bands = 'four'", "n_bands must be an integer, got 'four'"),
    ("seed = nan", "seed must be an integer, got nan"),
    ("realizations = true", "realizations must be an integer, got True"),
    ("disorder = 3", "disorder must be a table, got 3"),
    ("[disorder]\nxi = 1", "disorder must have only the keys"),
    ("[disorder]\nstrength = 'x'", "disorder.strength must be a number"),
    ("times = []", "times must hold at least one time"),
    ("times = [true, false]", "times must be real numbers"),
    ("times = [1" + "0" * 400 + "]", "times must be finite"),
    ("seed = 1" + "0" * 5000, "must be a TOML file"),
    ("a = " + "[" * 100_000, "must be a TOML file"),
    ("n_bands =", "must be a TOML file, got Invalid value"),
    ("[times]\nstop = 3", "times must have step"),
    ("observables = 'energy'", "observables must be a list of names"),
    ('boundary = """open\nring"""', "boundary must be one of periodic, fixed, got 'open\\nring'"),
    ("tolerance = 1979-05-27", "tolerance must be a number"),
]


@pytest.mark.parametrize(("text", "message"), CONFIGS, ids=[text[:30] for text, _ in CONFIGS])
def test_bad_configs(text, message, run, tmp_path):
    (tmp_path / "scene.toml").write_text(text)
    assert message in complains(run("simulate", "--config", "scene.toml", "--method", "modes", "--out", "out"))


def test_a_config_that_is_no_text(run, tmp_path):
    (tmp_path / "scene.toml").write_bytes(b"\xff\xfe\x00\x01")
    assert "must be a TOML file" in complains(run("simulate", "--config", "scene.toml", "--out", "out"))
    assert "No such file" in complains(run("simulate", "--config", "two\nlines.toml", "--out", "out"))


PREDICT_FLAGS = [
    ("--source 0", "source must be at least 1, got 0"),
    ("--source 5", "source must be at most 4, got 5"),
    ("--source x", "--source must be"),
    ("--source", "source must be a list of bands"),
    ("--initial 1 2", "initial must hold the 4 bands of the model, got 2 numbers"),
    ("--initial nan 0 0 0", "initial must be finite"),
    ("--initial x", "--initial must be"),
    ("--initial 1 -1 0 0", "initial must not be negative, got -1 at band 2"),
    ("--initial 1 0 0 0 --source 1", "source must not be given together with initial"),
    ("--method magic", "method must be one of expm, "),
    ("--times.step 0", "times.step must be greater than 0"),
    ("--times.stop -1", "times.stop must be at least 0"),
    ("--times.stop 1e9 --times.step 1e8 --method euler", "times must take at most 1000000 steps"),
    ("--device tpu", "device must be available here"),
    ("--seed x", "--seed must be INT"),
    ("--config nothing", "config nothing must be a readable file"),
    ("extra", "extra"),
]


@pytest.mark.parametrize(("flags", "message"), PREDICT_FLAGS, ids=[flags for flags, _ in PREDICT_FLAGS])
def test_bad_flags_of_predict(flags, message, run, calibrated):
    model = calibrated / "model.safetensors"
    assert message in complains(run("predict", model, *flags.split(), "--out", "out"))


REQUESTS = [
    ("source = 3", "source must be a list of bands, got 3"),
    ("source = 'all'", "source must be a list of bands"),
    ("source = [1.5]", "source must be an integer, got 1.5"),
    ("source = {a = 1}", "source must be a list of bands"),
    ("initial = [true, true, true, true]", "initial must be real numbers"),
    ("initial = [[1, 0, 0, 0]]", "initial must hold the 4 bands of the model"),
    ("initial = [1" + "0" * 400 + ", 0, 0, 0]", "initial must be finite"),
    ("times = 3", "times must be one-dimensional"),
    ("times = [2, 1]", "times must increase strictly"),
    ("[times]\nend = 3", "times must have only the keys start, stop, step"),
    ("n_bands = 4", "predict must have only the keys strength, source, initial, times"),
]


@pytest.mark.parametrize(("text", "message"), REQUESTS, ids=[text[:30] for text, _ in REQUESTS])
def test_bad_requests(text, message, run, calibrated, tmp_path):
    (tmp_path / "request.toml").write_text(text)
    model = calibrated / "model.safetensors"
    assert message in complains(run("predict", model, "--config", "request.toml", "--out", "out"))


def test_models_that_cannot_be_read(run, tmp_path):
    assert "must be a readable file" in complains(run("predict", "nothing.safetensors", "--out", "out"))
    assert "must be a file, got a folder" in complains(run("predict", ".", "--out", "out"))
    (tmp_path / "foreign").write_bytes(b"PK\x03\x04" + bytes(100))
    assert "must be a master equation saved by torchchain" in complains(run("predict", "foreign", "--out", "out"))
    assert "must be a readable file" in complains(run("predict", "two\nlines", "--out", "out"))
    complains(run("predict", "--out", "out"))


def test_places_that_cannot_be_written(run, tmp_path, calibrated, monkeypatch):
    def computed(*arguments, **settings):
        pytest.fail("a simulation ran before its folder was checked")

    monkeypatch.setattr("torchchain.cli.simulate.simulate", computed)
    (tmp_path / "file").write_text("mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for out, message in (
        ("file", "out must be a folder, got file"),
        ("file/below", "out must be writable, got file/below"),
        ("dangling", "out must be a folder, got dangling"),
        ("x" * 300, "out must be writable"),
        ("/proc/torchchain", "out must be writable"),
    ):
        if out.startswith("/proc"):
            monkeypatch.undo()  # found out when the folder is made: the run itself is small
            monkeypatch.chdir(tmp_path)
        assert message in complains(run("simulate", *SMALL, "--out", out))
    assert (tmp_path / "file").read_text() == "mine"
    model = calibrated / "model.safetensors"
    assert "out must be a folder" in complains(run("predict", model, "--out", "file"))
    assert "out must be a folder" in complains(run("calibrate", *SMALL, "--out", "file"))


def test_a_write_that_fails_leaves_nothing(run, monkeypatch, tmp_path):
    def full(data):
        def writer(path):
            path.write_bytes(b"half")
            raise OSError(28, "No space left on device")

        return writer

    monkeypatch.setattr(outputs, "dataset", full)
    assert "out must be writable, got out: No space left on device" in complains(
        run("simulate", *SMALL, "--out", "out")
    )
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "results.nc").write_text("before")
    complains(run("simulate", *SMALL, "--out", "old"))
    assert os.listdir(tmp_path / "old") == ["results.nc"]
    assert (tmp_path / "old" / "results.nc").read_text() == "before"


@pytest.mark.parametrize(
    ("failure", "status", "message"),
    [
        (DecompositionError("modes must satisfy\nthe equation"), 1, "modes must satisfy the equation"),
        (MemoryError(), 1, "MemoryError"),
        (RuntimeError("not enough memory: you tried to allocate 10 bytes"), 1, "not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted, nothing was written"),
    ],
)
def test_failures_that_are_not_the_users(failure, status, message, run, monkeypatch):
    def fails(*arguments, **settings):
        raise failure

    monkeypatch.setattr("torchchain.cli.simulate.simulate", fails)
    assert message in complains(run("simulate", *SMALL, "--out", "out"), status)


@pytest.mark.parametrize("arguments", [[], ["simulat"], ["--seed", "3"], ["simulate", "calibrate"]])
def test_commands_that_do_not_exist(arguments, run):
    complains(run(*arguments))


# As a program of its own


def test_help_answers_before_anything_heavy_is_imported():
    code = (
        "import sys; from torchchain.cli import main; status = main(['--help']);"
        "heavy = {'torch', 'numpy', 'scipy', 'xarray', 'matplotlib'} & set(sys.modules);"
        "print(heavy, file=sys.stderr) if heavy else None; sys.exit(status or bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    for name in ("simulate", "calibrate", "predict", "plan"):
        assert name in done.stdout


@pytest.mark.parametrize("command", ["simulate", "calibrate", "predict", "plan"])
def test_help_of_every_command(command, run):
    status, output, errors = run(command, "--help")
    assert (status, errors) == (0, "")
    for flag in ("--config", "--seed", "--out", "--device"):
        assert flag in output or command == "plan"


def test_as_a_module(tmp_path):
    def program(*arguments):
        return subprocess.run(
            [sys.executable, "-m", "torchchain", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    bad = program("simulate", "--config", "two\nlines.toml")
    assert (bad.returncode, bad.stdout) == (2, "")
    assert bad.stderr.startswith("torchchain: error: config two lines.toml must be a readable file")
    assert bad.stderr.count("\n") == 1
    assert os.listdir(tmp_path) == []
    good = program("simulate", *SMALL, "--out", "out")
    assert (good.returncode, good.stderr) == (0, "")
    assert sorted(os.listdir(tmp_path / "out")) == [
        "config.toml",
        "figure.png",
        "report.html",
        "results.nc",
        "run.json",
    ]
