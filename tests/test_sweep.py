"""``torchchain sweep`` and ``torchchain compare``: many runs in one file, and two results against each other."""

import csv
import json

import numpy as np
import pytest
import xarray

import torchchain as tc
from torchchain import cli
from torchchain.cli import outputs
from torchchain.cli.compare import differing
from torchchain.cli.sweep import combinations, panels, swept

CONFIG = "realizations = 6\nn_bands = 4\nn_particles = 32\ntimes = {stop = 5.0, step = 1.0}\nseed = 3\n"


@pytest.fixture(autouse=True)
def no_figures(monkeypatch, tmp_path):
    monkeypatch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(CONFIG)


def test_a_sweep_holds_what_single_runs_give(capsys):
    assert cli.main("sweep simulate disorder.strength=0.1,0.3 n_particles=32,64 --config s.toml --out s".split()) == 0
    assert "4 runs of simulate" in capsys.readouterr().out
    whole = xarray.load_dataset("s/sweep.nc", engine="h5netcdf")
    assert whole.attrs["left_out"].startswith("band_energy")  # the tones of 32 and of 64 particles differ
    with open("s/sweep.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["disorder.strength"], row["n_particles"]) for row in rows] == [
        ("0.1", "32"), ("0.1", "64"), ("0.3", "32"), ("0.3", "64"),
    ]  # fmt: skip
    single = ["simulate", "--config", "s.toml", "--disorder.strength", "0.3", "--n-particles", "64", "--out", "one"]
    assert cli.main(single) == 0
    alone, swept_one = (
        xarray.load_dataset(f"{place}/results.nc", engine="h5netcdf")
        for place in ("one", "s/runs/disorder.strength=0.3,n_particles=64")
    )
    assert alone["band_energy"].identical(swept_one["band_energy"])


def test_swept_axes_lead_and_carry_their_values():
    assert cli.main("sweep simulate disorder.strength=0.1,0.2,0.3 --config s.toml --out s".split()) == 0
    whole = xarray.load_dataset("s/sweep.nc", engine="h5netcdf")
    assert whole["band_energy"].dims[0] == "disorder.strength"
    assert whole["disorder.strength"].values.tolist() == [0.1, 0.2, 0.3]
    one = xarray.load_dataset("s/runs/disorder.strength=0.2/results.nc", engine="h5netcdf")
    assert (whole["band_energy"].sel({"disorder.strength": 0.2}).values == one["band_energy"].values).all()


def test_a_sweep_goes_on_where_it_was_stopped(capsys):
    command = "sweep simulate disorder.strength=0.1,0.2 --config s.toml --out s".split()
    assert cli.main(command) == 0
    first = json.loads(open("s/runs/disorder.strength=0.1/run.json").read())["started"]
    longer = "sweep simulate disorder.strength=0.1,0.2,0.4 --config s.toml --out s".split()
    stamp = {p: p.stat().st_mtime_ns for p in __import__("pathlib").Path("s/runs").glob("*/run.json")}
    assert cli.main(longer) == 0
    for path, time in stamp.items():
        assert path.stat().st_mtime_ns == time
    assert json.loads(open("s/runs/disorder.strength=0.1/run.json").read())["started"] == first
    assert xarray.load_dataset("s/sweep.nc", engine="h5netcdf").sizes["disorder.strength"] == 3


def test_a_sweep_of_calibrations():
    command = "sweep calibrate disorder.strength=0.1,0.3 calibration.model=paper --config s.toml --out s".split()
    assert cli.main(command) == 0
    whole = xarray.load_dataset("s/sweep.nc", engine="h5netcdf")
    assert whole["band_energy"].sizes["disorder.strength"] == 2
    assert not [name for name in whole.data_vars if name.startswith("block")]
    assert (whole["run_n_parameters"] == 16).all()
    assert (whole["run_tv"] > 0).all()
    for point, horizon in zip((0.1, 0.3), whole["run_horizon"].values.ravel(), strict=True):  # infinite where the models settle
        said = json.loads(open(f"s/runs/disorder.strength={point},calibration.model=paper/run.json").read())["numbers"]
        assert float(said["horizon"]) == float(horizon)
    opened = tc.open("s")
    assert opened.scene is None
    assert opened.data.identical(whole)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("sweep simulate", "fields"),
        ("sweep simulate disorder.strength", "fields must read field=value,value, got 'disorder.strength'"),
        ("sweep simulate n_particles=32,32", "n_particles must have different values"),
        ("sweep simulate n_particles=32 n_particles=64", "fields must be named once"),
        ("sweep simulate n_particels=32,64", "n_particels"),
        ("sweep simulate n_particles.x=1,2", "n_particles.x must name a field of the scene file"),
        ("sweep simulate n_particles=32,31", "n_particles must be even"),
        ("sweep predict n_particles=32,64", "command"),
        ("compare a b", "be a readable data file"),
        ("compare s.toml s.toml", "be a readable data file"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(words, message, capsys, tmp_path):
    more = ["--config", "s.toml"] if words.startswith("sweep") else []
    assert cli.main([*words.split(), *more, "--out", "out"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_words_of_a_sweep():
    assert swept(["a=1,2.5", "b.c=x,true"]) == {"a": (1, 2.5), "b.c": ("x", True)}
    points = list(combinations({"times.stop": (1.0, 2.0)}, {}))
    assert points[1].config == {"times": {"start": 0.0, "stop": 2.0, "step": 0.25}}


def test_two_runs_compared(capsys):
    for seed in ("1", "2"):
        assert cli.main(["simulate", "--config", "s.toml", "--seed", seed, "--out", f"run{seed}"]) == 0
    capsys.readouterr()
    assert cli.main("compare run1 run2 --out c".split()) == 0
    printed = capsys.readouterr().out
    assert "setting seed: 1 and 2" in printed
    assert "band_energy" in printed
    summary = json.loads(open("c/run.json").read())["summary"]["band_energy"]
    assert 0.3 < summary["rms_z"] < 3  # six realizations each
    assert cli.main("compare run1/results.nc run1 --out d".split()) == 0
    assert json.loads(open("d/run.json").read())["summary"]["band_energy"]["largest_difference"] == 0


def test_settings_that_differ():
    assert differing({"a": 1, "t": {"x": 1, "y": 2}}, {"a": 1, "t": {"x": 3}}) == {"t.x": (1, 3), "t.y": (2, None)}


def test_the_figure_shows_what_was_measured_with_its_errors_and_what_differs():
    data = xarray.Dataset({"run_tv": ("n", [0.1, 0.2]), "run_same": ("n", [1.0, 1.0]), "run_horizon": ("n", [np.inf, np.inf])})
    shown = panels(data, [{"measured": [("R", 1.0, 0.1), ("one", 1.0, 1.0)]}, {"measured": [("R", 2.0, None)]}])
    assert list(shown) == ["R", "total variation, model and ensemble"]
    np.testing.assert_array_equal(shown["R"], [[1.0, 2.0], [0.1, np.nan]])
    assert list(panels(data[["run_same"]], [{}, {}])) == ["same"]  # a figure all the same
