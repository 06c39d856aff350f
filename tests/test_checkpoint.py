"""A run killed at any moment goes on where it stopped, and ends with the same bits as one that was not."""

import itertools
import json
import multiprocessing
import os
import pkgutil
import resource
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
import xarray
from safetensors.torch import load_file

import torchchain as tc
from torchchain import cli
from torchchain.checks import FieldError
from torchchain.cli import outputs
from torchchain.ensemble import checkpoint
from torchchain.ensemble import run as ensemble
from torchchain.ensemble.checkpoint import Checkpoint, CheckpointWarning
from torchchain.ensemble.chunk import Chunk
from torchchain.ensemble.statistics import EnsembleMoments

SCENE = tc.Scene(n_particles=16, n_bands=4, realizations=40, seed=3, times=[0.0, 1.0, 7.0])
FLAGS = "--n-particles 16 --n-bands 4 --realizations 40 --times.stop 5 --seed 3 --method modes".split()
COMMANDS = {"simulate": FLAGS, "calibrate": [*FLAGS, *"--fit linear --model paper --bootstrap 0".split()]}  # quick fits
EVERY = ["--checkpoint-every", "0"]  # after every chunk of two chains
pytestmark = pytest.mark.filterwarnings("ignore:prediction to time")


def data_of(folder):
    """All numbers that a run left, as bytes by name."""
    found = {}
    for name in ("results.nc", "transfer.nc"):
        if (folder / name).exists():
            with xarray.open_dataset(folder / name, engine="h5netcdf") as data:
                found |= {str(key): values.values.tobytes() for key, values in data.load().variables.items()}
    if (folder / "model.safetensors").exists():
        found["model"] = (folder / "model.safetensors").read_bytes()
    assert found
    return found


def stopped_after(chunks, monkeypatch, stop=KeyboardInterrupt):
    """The run is interrupted when it has measured so many chunks."""
    observe, left = Chunk.observe, itertools.count(chunks, -1)

    def counted(chunk, names):
        if next(left) <= 0:
            raise stop
        return observe(chunk, names)

    monkeypatch.setattr(Chunk, "observe", counted)


def equal(a, b):
    return a.identical(b) and all(a[name].values.tobytes() == b[name].values.tobytes() for name in a.variables)


@pytest.fixture
def one_thread():
    """Chunks end in order, so that how many are kept is certain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def whole():
    return tc.simulate(SCENE, "modes")


# Killed at any moment


SERVER = multiprocessing.get_context("forkserver")  # forks from a process that has no threads yet
LATE = ["scipy.optimize", "xarray", "h5netcdf", "matplotlib.figure", "matplotlib.backends.backend_agg"]
SERVER.set_forkserver_preload(["torchchain.cli.dispatch", "test_checkpoint", *LATE])


def command_in_a_process(arguments, prepare):
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    outputs.figure = lambda drawn: lambda path: path.write_bytes(b"")
    prepare()
    os._exit(cli.main(arguments))


def forked(arguments, prepare):
    """The status of a command in a process of its own, where ``prepare`` is called first."""
    process = SERVER.Process(target=command_in_a_process, args=(arguments, prepare))
    process.start()
    process.join(120)
    return process.exitcode


def killed_at(owner, name, count, after):
    """SIGKILL at the count-th call of a function of the named owner, before or after it."""
    owner = pkgutil.resolve_name(owner)
    function, left = getattr(owner, name), itertools.count(count, -1)

    def deadly(*arguments, **settings):
        last = next(left) <= 0
        if last and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        result = function(*arguments, **settings)
        if last:
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, deadly)


MOMENTS = [  # the first four are of the checkpoint alone, whatever the command
    pytest.param("os", "replace", 0, False, id="before the first part appears"),
    pytest.param("os", "replace", 7, False, id="before a part is replaced"),
    pytest.param("os", "replace", 7, True, id="after a part is replaced"),
    pytest.param("os", "fsync", 9, False, id="in a part that is half written"),
    pytest.param("torchchain.ensemble.run:EnsembleMoments", "absorb", 5, True, id="between chunks"),
    pytest.param("torchchain.cli.outputs", "write", 0, False, id="before the results are written"),
    pytest.param("torchchain.cli.outputs", "sha256", 2, True, id="while the results are written"),
    pytest.param(
        "torchchain.ensemble.checkpoint:Checkpoint", "clear", 0, False, id="with results and checkpoint both there"
    ),
]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """Data of the commands that nothing disturbed."""
    found = {}
    for command in ("simulate", "calibrate"):
        out = tmp_path_factory.mktemp("reference") / command
        assert cli.main([command, *COMMANDS[command], "--out", str(out)]) == 0
        found[command] = data_of(out)
    return found


@pytest.mark.parametrize(
    ("command", "owner", "name", "count", "after"),
    [pytest.param("simulate", *moment.values, id=f"simulate-{moment.id}") for moment in MOMENTS]
    + [pytest.param("calibrate", *moment.values, id=f"calibrate-{moment.id}") for moment in MOMENTS[4:]],
)
def test_killed_and_resumed(command, owner, name, count, after, reference, tmp_path):
    arguments = [command, *COMMANDS[command], *EVERY, "--out", str(tmp_path / "out")]
    assert forked(arguments, partial(killed_at, owner, name, count, after)) == -signal.SIGKILL
    assert cli.main(arguments) == 0
    assert data_of(tmp_path / "out") == reference[command]
    assert "checkpoint" not in os.listdir(tmp_path / "out")
    assert os.listdir(tmp_path) == ["out"]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    if name == "absorb":
        assert record["resumed_realizations"] == 2 * 5
    if name == "clear":
        assert record["resumed_realizations"] == 40


def test_killed_again_and_again(reference, tmp_path):
    arguments = ["simulate", *FLAGS, *EVERY, "--out", str(tmp_path / "out")]
    for _ in range(3):
        killing = partial(killed_at, "torchchain.ensemble.run:EnsembleMoments", "absorb", 3, False)
        assert forked(arguments, killing) == -signal.SIGKILL
        assert len(os.listdir(tmp_path / "out" / "checkpoint")) <= 2  # what came before, and the session's own
    assert cli.main(arguments) == 0
    assert data_of(tmp_path / "out") == reference["simulate"]


def test_ctrl_c(tmp_path):
    """A long run, stopped as a person would, says in one line what it keeps, and the library goes on from there."""
    scene = replace(SCENE, realizations=100_000)
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    command = "simulate --config scene.toml --method modes --checkpoint-every 0.05 --out out".split()
    process = subprocess.Popen(
        [sys.executable, "-m", "torchchain", *command],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # which a shell's background jobs ignore
    )
    folder, patience = tmp_path / "out" / "checkpoint", time.monotonic() + 120
    while not list(folder.glob("*.safetensors")) and time.monotonic() < patience:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=120)
    assert (process.returncode, output) == (130, "")
    assert errors.count("\n") == 1
    assert errors.startswith("torchchain: error: interrupted: ")
    assert "of 100000 realizations are kept in out/checkpoint, the same command goes on from there" in errors
    assert os.listdir(tmp_path / "out") == ["checkpoint"]
    kept = int(errors.split()[3])
    (part,) = folder.iterdir()
    moments = EnsembleMoments.from_tensors(100_000, 1, load_file(part))
    assert moments.held() == [range(kept)]


# Kept and taken up in Python


def test_a_finished_run_is_not_computed_again(whole, tmp_path, monkeypatch):
    assert equal(tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path, 0)), whole)
    stopped_after(0, monkeypatch)
    assert equal(tc.simulate(SCENE, "modes", checkpoint=tmp_path), whole)


@pytest.mark.parametrize("chunks", [1, 2, 3, 10, 19])
@pytest.mark.usefixtures("one_thread")
def test_interrupted_and_resumed(chunks, whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stopped_after(chunks, patch)
        with pytest.raises(KeyboardInterrupt, match=f"{2 * chunks} of 40 realizations are kept"):
            tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path, 0))
    again = Checkpoint(tmp_path, 0)
    assert equal(tc.simulate(SCENE, "modes", checkpoint=again), whole)
    assert again.resumed == 2 * chunks


@pytest.mark.usefixtures("one_thread")
def test_a_failure_keeps_what_is_finished(whole, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        stopped_after(4, patch, RuntimeError("a machine check"))
        with pytest.raises(RuntimeError, match="a machine check"):
            tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path, 0))
    again = Checkpoint(tmp_path, 0)
    assert equal(tc.simulate(SCENE, "modes", checkpoint=again), whole)
    assert again.resumed == 8


def test_a_transfer_goes_on(tmp_path, monkeypatch):
    expected = tc.band_transfer(SCENE, "modes")
    with monkeypatch.context() as patch:
        stopped_after(7, patch)
        with pytest.raises(KeyboardInterrupt):
            tc.band_transfer(SCENE, "modes", checkpoint=Checkpoint(tmp_path, 0))
    found = tc.band_transfer(SCENE, "modes", checkpoint=tmp_path)
    for name in ("mean", "stderr", "long_time", "long_time_stderr", "block_mean", "block_long_time"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_short_runs_leave_nothing(tmp_path, monkeypatch):
    tc.simulate(SCENE, "modes", checkpoint=tmp_path / "kept")
    stopped_after(4, monkeypatch)
    with pytest.raises(KeyboardInterrupt, match="nothing was written"):
        tc.simulate(SCENE, "modes", checkpoint=tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


def test_the_plan_is_kept_too(tmp_path, monkeypatch):
    """Another machine, or a busy one, may plan otherwise: what began by one method goes on by it."""
    scene = replace(SCENE, observables=("band_energy", "energy"))
    plans = iter([("modes", {}), ("chebyshev", {"accuracy": 1e-9})])
    monkeypatch.setattr(ensemble, "chosen", lambda *_, **__: next(plans))
    with monkeypatch.context() as patch:
        stopped_after(3, patch)
        with pytest.raises(KeyboardInterrupt):
            tc.simulate(scene, checkpoint=Checkpoint(tmp_path, 0))
    monkeypatch.setattr(
        ensemble, "chosen", lambda scene, method, options=None, names=None: (method, dict(options or {}))
    )
    assert tc.simulate(scene, checkpoint=tmp_path).attrs["method"] == "modes"


@pytest.mark.usefixtures("one_thread")
def test_few_numbers_are_kept(tmp_path):
    """Nodes of the moments, not realizations: 1023 chains of three numbers each take ten nodes or fewer."""
    scene = replace(SCENE, realizations=1023, observables=("center",))
    with pytest.MonkeyPatch.context() as patch:
        stopped_after(1000, patch)
        patch.setattr("torchchain.ensemble.layout.GROUPS", 10_000)  # one chain a chunk
        with pytest.raises(KeyboardInterrupt, match="1000 of 1023"):
            tc.simulate(scene, "modes", checkpoint=Checkpoint(tmp_path, 1e-9))
    (part,) = tmp_path.iterdir()
    nodes = [name for name in load_file(part) if name.startswith("center") and name.endswith("mean")]
    assert len(nodes) == (1000).bit_count()


# Damage, other settings, full disks


def interrupted(folder, monkeypatch, chunks=10):
    with monkeypatch.context() as patch:
        stopped_after(chunks, patch)
        with pytest.raises(KeyboardInterrupt):
            tc.simulate(SCENE, "modes", checkpoint=Checkpoint(folder, 0))
    (part,) = folder.iterdir()
    return part


def flip(content):
    return content[:-5] + bytes([content[-5] ^ 1]) + content[-4:]


@pytest.mark.parametrize(
    "damage",
    [
        flip,
        lambda content: content[:-1],
        lambda content: content[:100],
        lambda content: b"",
        lambda content: b"\xff" * 8 + content[8:],
        lambda content: content.replace(b"whole", b"w hole").replace(b"0/mean", b"1/mean"),
        lambda content: content.replace(b'\\"seed\\": 3', b'\\"seed\\": 4'),
    ],
    ids=["a bit", "the end", "the data", "everything", "the header's size", "a name", "the settings"],
)
def test_damage_is_found_reported_and_computed_again(damage, whole, tmp_path, monkeypatch):
    part = interrupted(tmp_path, monkeypatch)
    before = part.read_bytes()
    part.write_bytes(damage(before))
    assert part.read_bytes() != before
    again = Checkpoint(tmp_path, 0)
    with pytest.warns(CheckpointWarning, match=f"{part.name} is damaged .* its realizations are computed again"):
        assert equal(tc.simulate(SCENE, "modes", checkpoint=again), whole)
    assert again.resumed == 0


def test_the_same_realizations_twice_count_once(whole, tmp_path, monkeypatch):
    part = interrupted(tmp_path, monkeypatch)
    part.with_name("00001-00007.safetensors").write_bytes(part.read_bytes())
    again = Checkpoint(tmp_path, 0)
    with pytest.warns(CheckpointWarning, match="is held twice"):
        assert equal(tc.simulate(SCENE, "modes", checkpoint=again), whole)
    assert again.resumed == 20


def test_leftovers_of_a_save_are_cleared_and_other_files_left_alone(whole, tmp_path, monkeypatch):
    interrupted(tmp_path, monkeypatch)
    (tmp_path / "00001-00000.safetensors.tmp").write_bytes(b"half")
    (tmp_path / "mine.txt").write_text("mine")
    assert equal(tc.simulate(SCENE, "modes", checkpoint=tmp_path), whole)
    assert not list(tmp_path.glob("*.tmp"))
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_one_run_a_folder(tmp_path):
    with Checkpoint(tmp_path / "kept").lock():
        with pytest.raises(FieldError, match=rf"checkpoint must be free, got .*/kept, where process {os.getpid()} on"):
            tc.simulate(SCENE, "modes", checkpoint=tmp_path / "kept")
        tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path / "kept.1", 0))
    assert sorted(os.listdir(tmp_path)) == ["kept.1"]


def test_clearing_takes_only_what_the_run_has_left(tmp_path):
    tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path / "kept", 0))
    (tmp_path / "kept" / "mine.txt").write_text("mine")
    Checkpoint(tmp_path / "kept").clear()
    assert os.listdir(tmp_path / "kept") == ["mine.txt"]


def test_going_on_says_of_how_many(tmp_path, monkeypatch, caplog):
    interrupted(tmp_path, monkeypatch)
    with caplog.at_level("INFO", logger="torchchain"):
        tc.simulate(SCENE, "modes", checkpoint=tmp_path)
    assert [record.message for record in caplog.records] == [
        f"20 of 40 realizations are in {tmp_path}: going on from there"
    ]


CHANGES = [
    ("--seed 4", "seed must stay 3 as in the unfinished run in out/checkpoint", "got 4"),
    ("--realizations 41", "realizations must stay 40", "got 41"),
    ("--disorder.strength 0.2", "disorder.strength must stay 0.3", "got 0.2"),
    ("--times.stop 6", "times.stop must stay 5.0", "got 6.0"),
    ("--n-particles 24", "n_particles must stay 16", "got 24"),
    ("--boundary fixed", "boundary must stay 'periodic'", "got 'fixed'"),
    ("--excitation.kind impulse", "excitation.kind must stay 'standing_wave'", "got 'impulse'"),
    ("--observables center", "measured must stay ['band_energy']", "got ['center']"),
    ("--method chebyshev", "method must stay 'modes'", "got 'chebyshev'"),
]


@pytest.mark.parametrize(("flags", "rule", "value"), CHANGES)
def test_other_settings_are_refused(flags, rule, value, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["simulate", *FLAGS, *EVERY, "--out", "out"]
    with monkeypatch.context() as patch:
        stopped_after(3, patch)
        assert cli.main(arguments) == 130
    before = {path: path.read_bytes() for path in (tmp_path / "out" / "checkpoint").iterdir()}
    capsys.readouterr()
    assert cli.main([*arguments, *flags.split()]) == 2
    output, errors = capsys.readouterr()
    assert output == ""
    assert errors.count("\n") == 1
    assert rule in errors
    assert errors.rstrip().endswith(value)
    assert {path: path.read_bytes() for path in (tmp_path / "out" / "checkpoint").iterdir()} == before


def test_a_wrong_interval(tmp_path):
    with pytest.raises(FieldError, match="checkpoint_every must be at least 0, got -1"):
        Checkpoint(tmp_path, -1)


def test_a_full_disk_ends_no_run(whole, tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.warns(CheckpointWarning, match="could not be written: No space left on device; the run goes on"):
        assert equal(tc.simulate(SCENE, "modes", checkpoint=Checkpoint(tmp_path, 0)), whole)
    assert os.listdir(tmp_path) == []


def test_no_room_for_the_results(reference, tmp_path):
    """With files limited to a kilobyte neither checkpoint nor results fit; nothing half-written stays."""
    arguments = ["simulate", *FLAGS, *EVERY, "--out", str(tmp_path / "out")]
    limits = (1024, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    assert forked(arguments, partial(resource.setrlimit, resource.RLIMIT_FSIZE, limits)) == 2
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert left == []
    assert cli.main(arguments) == 0
    assert data_of(tmp_path / "out") == reference["simulate"]


def test_a_disk_that_fills_up_keeps_the_checkpoint(reference, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def full(data):
        def writer(path):
            path.write_bytes(b"half")
            raise OSError(28, "No space left on device")

        return writer

    arguments = ["simulate", *FLAGS, *EVERY, "--out", "out"]
    with monkeypatch.context() as patch:
        patch.setattr(outputs, "dataset", full)
        assert cli.main(arguments) == 2
    assert "out must be writable, got out: No space left on device" in capsys.readouterr().err
    assert os.listdir("out") == ["checkpoint"]
    with monkeypatch.context() as patch:
        stopped_after(0, patch)  # nothing is computed again
        assert cli.main(arguments) == 0
    assert data_of(tmp_path / "out") == reference["simulate"]


def test_pairs_are_resumed(tmp_path, monkeypatch):
    scene = tc.Scene(
        16, n_bands=4, realizations=26, times=[0.0, 3.0], opposite_pairs=True, observables=("band_energy",)
    )
    whole = tc.simulate(scene, "chebyshev", memory_budget=1)
    checkpoint = Checkpoint(tmp_path, every=0)
    with monkeypatch.context() as patch:
        stopped_after(4, patch)
        with pytest.raises(KeyboardInterrupt, match=r"(\d+) of 26 realizations") as caught:
            tc.simulate(scene, "chebyshev", memory_budget=1, checkpoint=checkpoint)
    again = Checkpoint(tmp_path, every=0)
    assert equal(tc.simulate(scene, "chebyshev", memory_budget=1, checkpoint=again), whole)
    assert again.resumed == int(str(caught.value).split()[1])
    assert again.resumed >= 2
    assert again.resumed % 2 == 0


def test_nodes_go_through_files_unchanged(tmp_path):
    values = torch.randn(13, 2, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moments = EnsembleMoments(13, 3)
    moments.add(0, {"a": values[:6], "b": values[:6, 0]})
    moments.add(9, {"a": values[9:], "b": values[9:, 0]})
    again = EnsembleMoments.from_tensors(13, 3, moments.tensors())
    assert again.held() == moments.held() == [range(6), range(9, 13)]
    for part in (moments, again):
        part.add(6, {"a": values[6:9], "b": values[6:9, 0]})
    for name in ("a", "b"):
        for one, two in zip(moments.blocks(name), again.blocks(name), strict=True):
            assert one.count == two.count
            assert torch.equal(one.mean, two.mean)
            assert torch.equal(one.squares, two.squares)
    np.testing.assert_allclose(moments.blocks("a")[1].mean, values[4:8].mean(0), rtol=1e-14, atol=1e-15)
