"""A run made again from its record: the same to the last bit, or what differs and by how much."""

import json
import os
import shutil

import numpy as np
import pytest
import xarray
from safetensors.numpy import load_file, save_file

from torchchain import cli
from torchchain.cli import outputs
from torchchain.cli.rerun import difference
from torchchain.ensemble import plan as planning

SMALL = "--n-particles 16 --n-bands 4 --realizations 6 --times.stop 5 --seed 5".split()
pytestmark = pytest.mark.filterwarnings("ignore::torchchain.master.equation.PredictionWarning")


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run of each command; the ensembles by a plan, one with options of its own."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planning, "plan", planned(planning.plan, "verlet", {"step": 0.05}))
        patch.chdir(folder)
        assert cli.main(["simulate", *SMALL, "--observables", "energy", "center", "--out", "simulate"]) == 0
        patch.undo()
        patch.chdir(folder)
        assert cli.main(["calibrate", *SMALL, "--method", "modes", "--out", "calibrate"]) == 0
        assert (
            cli.main(
                ["predict", "calibrate/model.safetensors", "--times.stop", "4", "--source", "2", "--out", "predict"]
            )
            == 0
        )
    return folder


def planned(plan, method, options):
    """A machine whose plan is this one."""

    def other(scene, *arguments, **settings):
        found = plan(scene, *arguments, **settings)
        object.__setattr__(found, "method", method)
        object.__setattr__(found, "options", options)
        return found

    return other


@pytest.fixture
def copied(runs, tmp_path, monkeypatch):
    """The runs in a folder of this test."""
    shutil.copytree(runs, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", ["simulate", "calibrate", "predict"])
def test_the_same_again(command, runs, copied, capsys):
    before = sorted(os.listdir(copied))
    assert cli.main(["rerun", command]) == 0
    assert "equal to the last bit" in capsys.readouterr().out
    assert sorted(os.listdir(copied)) == before
    assert cli.main(["rerun", command, "--out", "again"]) == 0
    assert sorted(os.listdir("again")) == sorted(os.listdir(command))
    assert cli.main(["rerun", "again"]) == 0  # the record of a rerun is a record


def test_the_plan_of_the_record_is_followed(copied, capsys):
    record = json.loads((copied / "simulate" / "run.json").read_text())
    assert record["method"] == "auto"
    assert record["resolved"]["method"] == "verlet"
    assert record["resolved"]["options"]["step"] == 0.05
    assert cli.main(["rerun", "simulate"]) == 0  # this machine would plan otherwise


def test_a_changed_number_is_named(copied, capsys):
    path = copied / "simulate" / "results.nc"
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        data = data.load()
    data["center"].values[1, 2] += 2**-40
    os.unlink(path)
    data.to_netcdf(path, engine="h5netcdf")
    assert cli.main(["rerun", "simulate"]) == 1
    output = capsys.readouterr().out
    assert "differs: results.nc: center has 1 of 84 numbers changed, by up to 9.09e-13" in output
    assert output.count("differs") == 1
    assert "note: results.nc has changed since the run" in output


def test_a_changed_model_is_named(copied, capsys):
    path = copied / "calibrate" / "model.safetensors"
    tensors = load_file(path)
    name = next(name for name in ("rates", "law_values") if name in tensors)
    tensors[name] = np.nextafter(tensors[name], 9.0)
    save_file(tensors, path)
    assert cli.main(["rerun", "calibrate"]) == 1
    size = tensors[name].size
    assert f"differs: model.safetensors: {name} has {size} of {size} numbers changed" in capsys.readouterr().out


def complaint(capsys, *arguments):
    capsys.readouterr()
    assert cli.main(["rerun", *arguments]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.count("\n") == 1
    return errors


def test_a_model_that_moved_or_changed(copied, capsys):
    record = json.loads((copied / "predict" / "run.json").read_text())
    model = copied / "calibrate" / "model.safetensors"
    record["model"]["path"] = str(model)
    (copied / "predict" / "run.json").write_text(json.dumps(record))
    assert cli.main(["rerun", "predict"]) == 0
    tensors = load_file(model)
    save_file(tensors, model)  # the same numbers without the header
    assert f"model must have the SHA-256 {record['model']['sha256']} of the run, got " in complaint(capsys, "predict")
    model.unlink()
    assert f"model must be where the run found it, with SHA-256 {record['model']['sha256']}, got no file" in complaint(
        capsys, "predict"
    )


def test_folders_that_hold_no_run(copied, capsys):
    assert "folder nothing must hold the run.json and config.toml of a run" in complaint(capsys, "nothing")
    with open("simulate/config.toml", "a") as file:
        file.write("# mine\n")
    assert "config.toml must be the one that the run left, got a changed file" in complaint(capsys, "simulate")
    (copied / "calibrate" / "transfer.nc").unlink()
    assert "must hold transfer.nc to compare with" in complaint(capsys, "calibrate")
    (copied / "predict" / "run.json").write_text("{")
    assert "run.json must be JSON" in complaint(capsys, "predict")
    (copied / "predict" / "run.json").write_text("[]")
    assert "must hold a run of simulate, calibrate, predict" in complaint(capsys, "predict")


def test_the_folder_itself_is_not_replaced(copied, capsys):
    before = {path.name: path.read_bytes() for path in (copied / "simulate").iterdir()}
    assert "out must be another folder than the one that is made again" in complaint(
        capsys, "simulate", "--out", "calibrate/../simulate"
    )
    assert {path.name: path.read_bytes() for path in (copied / "simulate").iterdir()} == before


def test_the_record_says_what_is_needed(copied):
    for command in ("simulate", "calibrate", "predict"):
        record = json.loads((copied / command / "run.json").read_text())
        needed = {
            "command", "arguments", "working_directory", "config_sha256", "versions", "device", "threads", "seconds",
            "git_revision", "seed", "method", "files",
        }  # fmt: skip
        assert needed <= record.keys()
        for name, digest in record["files"].items():
            assert outputs.sha256(copied / command / name) == digest
        assert set(record["files"]) | {"run.json"} == set(os.listdir(command))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ([1.0, 2.0], [1.0, 2.0], ""),
        ([1.0, np.inf, np.nan], [1.0, np.inf, np.nan], ""),
        ([1.0, 2.0], [1.0, 2.5], "has 1 of 2 numbers changed, by up to 0.5 (its largest is 2)"),
        ([1.0, np.inf], [1.0, 2.0], "has 1 of 2 numbers changed, by up to inf (its largest is 1)"),
        ([0.0], [-0.0], "has 0 of 1 numbers changed, by up to 0 (its largest is 0)"),
        ([1.0, 2.0], [1.0], "was float64 (2,), is float64 (1,)"),
        ([1, 2], [1, 3], "was [1, 2], is [1, 3]"),
        (["a"], ["a"], ""),
    ],
)
def test_differences_in_words(old, new, words):
    assert difference(np.array(old), np.array(new)) == words
