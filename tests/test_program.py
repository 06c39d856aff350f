"""The command as a program among others: signals, pipes, warnings, two at once, help, and names from outside."""

import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import torchchain as tc
from torchchain import cli
from torchchain.cli import choices, flags, outputs
from torchchain.spelling import meant

SMALL = "--n-particles 32 --n-bands 4 --realizations 4 --times.stop 5 --seed 5 --method modes".split()
COMMAND = [sys.executable, "-m", "torchchain"]


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    out = tmp_path_factory.mktemp("calibrated") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
        assert cli.main(["calibrate", *SMALL, "--out", str(out)]) == 0
    return out


def complaint(capsys, *arguments):
    capsys.readouterr()
    assert cli.main([str(argument) for argument in arguments]) == 2
    output, errors = capsys.readouterr()
    assert (output, errors.count("\n")) == ("", 1)
    return errors


# A folder of its own


@pytest.mark.parametrize("out", ["", " "])
def test_no_folder_is_no_place(out, calibrated, capsys):
    for command in (["simulate", *SMALL], ["calibrate", *SMALL], ["predict", calibrated]):
        assert "out must be a folder, got '" in complaint(capsys, *command, "--out", out)
    assert os.listdir() == []


def test_a_finished_run_clears_what_dead_runs_left_and_nothing_else():
    dead = subprocess.run(COMMAND + ["--version"], check=True, capture_output=True)  # noqa: RUF005
    assert dead.stdout.startswith(b"torchchain ")
    gone = ThreadPoolExecutor(1)  # a process that has ended, whose number is free
    child = gone.submit(subprocess.Popen, [sys.executable, "-c", ""]).result()
    child.wait()
    kept = [
        f".run.1.{child.pid}-abcdefgh.part",  # of the folder run.1
        f".run.{os.getpid()}-abcdefgh.part",  # of a run under way
        ".run.mine.part",
        f".run.{child.pid}-abcdefgh.part.txt",
    ]
    for name in [*kept, f".run.{child.pid}-abcdefgh.part"]:
        os.mkdir(name)
    assert cli.main(["simulate", *SMALL, "--out", "run"]) == 0
    assert sorted(os.listdir()) == sorted([*kept, "run"])


def test_two_runs_into_one_folder(capsys, monkeypatch):
    def during(*arguments, **settings):
        errors = complaint(capsys, "simulate", *SMALL, "--out", "run")
        assert "out must be free, got run, where process " in errors
        assert cli.main(["simulate", *SMALL, "--out", "run.1"]) == 0
        return simulate(*arguments, **settings)

    simulate = tc.simulate
    from torchchain.cli import simulate as module

    def once(*arguments, **settings):
        monkeypatch.setattr(module, "simulate", simulate)
        return during(*arguments, **settings)

    monkeypatch.setattr(module, "simulate", once)
    assert cli.main(["simulate", *SMALL, "--out", "run"]) == 0
    assert sorted(os.listdir()) == ["run", "run.1"]
    assert sorted(os.listdir("run")) == sorted(os.listdir("run.1"))


# Signals, pipes, warnings


@pytest.mark.parametrize("delay", [0.05, 0.15, 0.3, 0.6, 1.5])
def test_an_interrupt_at_any_time_is_one_line(delay):
    # Before this package has set its own handler Python's counts: the signal is held back until then.
    code = """
import signal, sys
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
install = signal.signal
def first(*arguments):
    signal.signal = install
    before = install(*arguments)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    return before
signal.signal = first
print("begun", flush=True)
from torchchain.cli import main
sys.exit(main())
"""
    process = subprocess.Popen(
        [sys.executable, "-c", code, "simulate", "--realizations", "100000", "--method", "modes", "--out", "out"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "begun\n"
    time.sleep(delay)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=300)
    assert "Traceback" not in errors
    assert errors.startswith("torchchain: error: interrupted")
    assert (process.returncode, output, errors.count("\n")) == (130, "", 1)


@pytest.mark.parametrize("arguments", [["--help"], ["simulate", "--help"], ["--version"]])
def test_a_reader_that_has_gone(arguments):
    process = subprocess.Popen(COMMAND + arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    errors = process.stderr.read()
    assert (process.wait(), errors) == (141, "")


def test_results_are_written_though_nobody_reads():
    arguments = ["simulate", *SMALL, "--observables", "center", "--out", "out"]
    process = subprocess.Popen(COMMAND + arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    errors = process.stderr.read()
    assert (process.wait(), errors) == (141, "")
    assert sorted(os.listdir("out")) == ["config.toml", "figure.png", "report.html", "results.nc", "run.json"]


def test_warnings_as_errors_cost_no_result():
    # Of one realization not every pair of bands has a nonlinear fit, and the model of it makes energy.
    arguments = ["calibrate", *SMALL, "--realizations", "1", "--fit", "nonlinear", "--model", "paper", "--out", "out"]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "torchchain", *arguments], capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr
    assert "warning: nonlinear fit did not converge" in done.stdout
    assert "model.safetensors" in os.listdir("out")


# Help


def test_help_lists_what_there_is():
    from torchchain.chain.chain import BOUNDARIES, CONTACTS
    from torchchain.chain.disorder import KINDS
    from torchchain.energy import DEFINITIONS
    from torchchain.ensemble.scene_file import EXCITATIONS

    assert choices.KINDS == KINDS
    assert choices.BOUNDARIES == BOUNDARIES
    assert (*CONTACTS, "auto") == choices.CONTACTS
    assert set(choices.DEFINITIONS) == set(DEFINITIONS)
    assert set(choices.EXCITATIONS) == set(EXCITATIONS)
    assert set(choices.METHODS) == set(tc.METHODS)
    assert set(choices.SOLVERS) == set(tc.SOLVERS)
    assert set(choices.OBSERVABLES) == set(tc.OBSERVABLES)
    assert set(choices.MODELS) == set(tc.MODELS)
    assert set(choices.FITS) == {fit.name for model in tc.MODELS.values() for fit in model.fits}


def test_help_shows_the_defaults_of_a_scene():
    scene = tc.Scene()
    plain = {name: value for name, value in scene.to_dict().items() if name not in ("times", "disorder", "excitation")}
    plain |= {f"disorder.{k}": v for k, v in scene.to_dict()["disorder"].items()}
    plain |= {f"excitation.{k}": v for k, v in scene.to_dict()["excitation"].items()}
    plain |= {f"times.{k}": v for k, v in scene.to_dict()["times"].items()}
    shown = helped("simulate")
    for name, value in plain.items():
        text = " ".join(value) if isinstance(value, list) else value
        flag = f"--{name.replace('_', '-')}"
        assert f"(default: {text})" in shown[flag], flag
    for command in flags.COMMANDS:
        assert all(about.count("(default") <= 1 and "None" not in about for about in helped(command).values())


def helped(command):
    """The help of every flag of a command."""
    done = subprocess.run(
        [*COMMAND, command, "--help"], capture_output=True, text=True, check=True, env={**os.environ, "COLUMNS": "80"}
    )
    found, name = {}, ""
    for line in done.stdout.splitlines():
        words = line.strip("│ ").split()
        if words and words[0].startswith("--"):
            name = words[0]
        found[name] = found.get(name, "") + " ".join(words) + " "
    return found


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ("simulate --xi 0.1", "--disorder.strength"),
        ("simulate --n-particle 16", "--n-particles"),
        ("simulate --disorder.strenth 0.2", "--disorder.strength"),
        ("simulate --n_bnds=4", "--n-bands"),
        ("calibrate --chains 5", "--realizations"),
        ("simulat", "simulate"),
        ("simulate --width", "--observables width"),
        ("sweep simulate xi=0.1,0.3", "disorder.strength"),
        ("sweep simulate site=1,2", "excitation.site"),
        ("simulate --observables centre", "center"),
        ("simulate --method chebychev", "chebyshev"),
        ("simulate --boundary ring", "periodic"),
        ("simulate --disorder.kind gaussian", "normal"),
    ],
)
def test_what_was_meant(arguments, word, capsys):
    assert complaint(capsys, *arguments.split()).endswith(f"; did you mean {word}?\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("plan --method modes", "Unrecognized options: --method, modes\n"),
        ("frob --x 3", "error: frob is none of the commands simulate, calibrate,"),
        ("compare a", "torchchain compare needs FILE|FOLDER the other\n"),
        ("calibrate --observables width", "observables must be left out: a calibration measures the energies of bands"),
    ],
)
def test_mistakes_are_one_phrase(arguments, words, capsys):
    assert words in complaint(capsys, *arguments.split())


def test_no_guess_where_nothing_is_near(capsys):
    assert "did you mean" not in complaint(capsys, "simulate", "--quux", "3")
    assert meant("", ["a"]) is None
    with pytest.raises(tc.FieldError, match="got 'n_particle'; did you mean n_particles"):
        tc.Scene.from_dict({"n_particle": 3})


def test_the_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"torchchain {tc.__version__}\n"


# What a folder holds


def test_the_folder_of_a_calibration(calibrated):
    run = tc.open(calibrated)
    assert run.scene.n_particles == 32
    assert run.record["seed"] == 5
    assert set(run.data["band_energy"].dims) == {"source", "time", "receiver"}
    again = tc.calibrate(run.transfer)
    np.testing.assert_array_equal(again.basis.numpy(), run.master.basis.numpy())
    assert run.prediction.dims == run.data["band_energy"].dims
    assert "model.safetensors" in repr(run)


def test_the_folder_of_a_simulation_and_of_a_prediction(calibrated):
    assert cli.main(["simulate", *SMALL, "--observables", "center", "--out", "sim"]) == 0
    run = tc.open("sim")
    assert run.scene.observables == ("center",)
    assert run.data["center"].dims == ("tone", "time")
    with pytest.raises(tc.FieldError, match="be a readable data file"):
        _ = run.transfer
    with pytest.raises(tc.FieldError, match="hold model.safetensors"):
        _ = run.master
    assert cli.main(["predict", str(calibrated), "--source", "2", "--out", "pred"]) == 0
    assert tc.open("pred").prediction.dims == ("start", "time", "band")
    assert tc.open("pred").scene is None
    assert tc.open("pred").master.n_bands == 4


@pytest.mark.parametrize("path", ["nothing", "empty", "file"])
def test_folders_that_hold_no_run(path):
    os.mkdir("empty")
    with open("file", "w"):
        pass
    with pytest.raises(tc.FieldError, match="folder"):
        tc.open(path)


def test_prediction_from_the_folder_is_that_from_the_file(calibrated):
    assert cli.main(["predict", str(calibrated), "--out", "a"]) == 0
    assert cli.main(["predict", str(calibrated / "model.safetensors"), "--out", "b"]) == 0
    assert tc.open("a").data.identical(tc.open("b").data)
    assert cli.main(["rerun", "a"]) == 0


# A transfer from a file


def test_a_calibration_goes_on_from_a_transfer(calibrated, capsys):
    for given in (calibrated, calibrated / "transfer.nc"):
        assert cli.main(["calibrate", "--transfer", str(given), "--out", "again"]) == 0
    assert open("again/model.safetensors", "rb").read() == open(calibrated / "model.safetensors", "rb").read()
    assert tc.open("again").data.identical(tc.open(calibrated).data)
    assert cli.main(["rerun", "again"]) == 0
    assert cli.main(["calibrate", "--transfer", "again", "--fit", "linear", "--out", "linear"]) == 0
    assert tc.open("linear").master.calibration.method == "linear"
    assert "not be given together with transfer" in complaint(
        capsys, "calibrate", "--transfer", "again", "--seed", "3", "--out", "out"
    )
    assert "must be a readable data file" in complaint(capsys, "calibrate", "--transfer", "nothing", "--out", "out")
    shutil.copy("again/model.safetensors", "again/transfer.nc")
    assert "must be a readable data file" in complaint(capsys, "calibrate", "--transfer", "again", "--out", "out")
    assert not os.path.exists("out")


# Plugins


def test_plugins_that_cannot_be_loaded(capsys):
    with open("broken.py", "w") as file:
        file.write("import nothing_of_this_name\n")
    with open("leaving.py", "w") as file:
        file.write("raise SystemExit(3)\n")
    assert "plugin must be a Python file or a module, got no file here.py" in complaint(
        capsys, "simulate", *SMALL, "--plugin", "here.py", "--out", "out"
    )
    assert "plugin must be importable, got broken.py: ModuleNotFoundError: No module named" in complaint(
        capsys, "simulate", *SMALL, "--plugin", "broken.py", "--out", "out"
    )
    assert "got leaving.py: SystemExit: 3" in complaint(capsys, "plan", "--plugin", "leaving.py")
    assert "got nothing_of_this_name: ModuleNotFoundError" in complaint(
        capsys, "calibrate", *SMALL, "--plugin", "nothing_of_this_name", "--out", "out"
    )
    with open("scene.toml", "w") as file:
        file.write("plugins = 3\n")
    assert "plugins must be a list of files or modules, got 3" in complaint(
        capsys, "simulate", "--config", "scene.toml", "--out", "out"
    )
    assert not os.path.exists("out")
