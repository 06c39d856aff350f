"""Any number of processes gives the same bits, and a process that dies takes little with it."""

import json
import os
import subprocess
import sys

import pytest
import torch
import xarray

import torchchain as tc
from torchchain import cli
from torchchain.cli import outputs
from torchchain.ensemble import ranks
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.statistics import joined

FLAGS = "--n-particles 16 --n-bands 4 --realizations 45 --times.stop 5 --seed 3 --method modes".split()
FIT = "--fit linear --model paper --bootstrap 0".split()  # quick
pytestmark = pytest.mark.filterwarnings("ignore::torchchain.master.equation.PredictionWarning")


def python(folder, *arguments):
    """Python in a folder; returns what is left of it when it has ended."""
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip


def torchrun(n, folder, *arguments):
    """The command on n processes."""
    return python(
        folder, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={n}", "-m", "torchchain", *arguments
    )


def data_of(path):
    with xarray.open_dataset(path, engine="h5netcdf") as data:
        return {str(name): values.values.tobytes() for name, values in data.load().variables.items()}


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """Run the command in this process, without drawing."""
    monkeypatch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))

    def run(*arguments, out):
        assert cli.main([*arguments, "--out", str(tmp_path / out)]) == 0
        return tmp_path / out

    return run


def test_two_processes(tmp_path, alone):
    done = torchrun(2, tmp_path, "calibrate", *FLAGS, *FIT, "--out", "two")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("results in two") == 1  # only rank 0 writes and speaks
    one, two = alone("calibrate", *FLAGS, *FIT, out="one"), tmp_path / "two"
    assert data_of(two / "transfer.nc") == data_of(one / "transfer.nc")
    assert (two / "model.safetensors").read_bytes() == (one / "model.safetensors").read_bytes()
    assert sorted(os.listdir(two)) == sorted(os.listdir(one))
    record = json.loads((two / "run.json").read_text())
    assert record["processes"] == 2
    assert record["threads"] == max(1, len(os.sched_getaffinity(0)) // 2)


DEATH = """
import itertools, os, signal, sys
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from torchchain.cli import dispatch
from torchchain import cli
from torchchain.ensemble import run as ensemble

absorb, left = ensemble.EnsembleMoments.absorb, itertools.count(4, -1)

def deadly(total, part):
    absorb(total, part)
    if os.environ["RANK"] == "1" and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0" and next(left) <= 0:
        os.kill(os.getpid(), signal.SIGKILL)

def work():
    ensemble.EnsembleMoments.absorb = deadly
    sys.exit(cli.main(sys.argv[1:]))

config = LaunchConfig(
    1, 1, nproc_per_node=3, run_id="death", rdzv_backend="c10d", rdzv_endpoint="localhost:0", max_restarts=1,
    start_method="fork", monitor_interval=0.1,
)
elastic_launch(config, work)()
"""
"""What torchrun does, with processes forked from one that has imported the libraries already."""


def test_a_process_that_dies_is_started_again_and_goes_on(tmp_path, alone):
    (tmp_path / "death.py").write_text(DEATH)
    arguments = ["simulate", *FLAGS, "--checkpoint-every", "0", "--out", "three"]
    done = python(tmp_path, "death.py", *arguments)
    assert done.returncode == 0, done.stderr
    assert data_of(tmp_path / "three" / "results.nc") == data_of(alone("simulate", *FLAGS, out="one") / "results.nc")
    record = json.loads((tmp_path / "three" / "run.json").read_text())
    assert record["processes"] == 3
    assert record["resumed_realizations"] >= 4 * 2  # of the one that died: all but the chunk it was in


class Lost(Ranks):
    """A process whose neighbors end before the moments meet."""

    begin = None

    def agree(self, value):
        Lost.begin = value if self.rank == 0 else Lost.begin
        return Lost.begin

    def total(self, moments):
        raise RuntimeError("another process of this run has ended")


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
@pytest.mark.parametrize("size", [2, 3, 8])
def test_one_process_takes_up_what_others_left(size, method, tmp_path):
    scene = tc.Scene(n_particles=16, n_bands=4, realizations=45, seed=3, times=[0.0, 1.0, 7.0])
    expected = tc.simulate(scene, method)
    for rank in range(size - 1):  # the last one leaves nothing
        with pytest.raises(RuntimeError, match="has ended"):
            tc.simulate(scene, method, checkpoint=Checkpoint(tmp_path, 0), ranks=Lost(rank, size))
    assert len(os.listdir(tmp_path)) == size - 1
    again = Checkpoint(tmp_path, 0)
    found = tc.simulate(scene, method, checkpoint=again)
    assert 0 < again.resumed < 45
    assert found.identical(expected)
    assert all(found[name].values.tobytes() == expected[name].values.tobytes() for name in found.variables)


@pytest.mark.parametrize("size", [1, 2, 3, 7, 64])
@pytest.mark.parametrize("multiple", [1, 4, 5])
@pytest.mark.parametrize("ranges", [[range(100)], [range(3, 20), range(40, 41), range(60, 100)], [range(99, 100)], []])
def test_shares_hold_every_realization_once(size, multiple, ranges):
    shares = [Ranks(rank, size).part(ranges, multiple) for rank in range(size)]
    assert joined(part for share in shares for part in share) == ranges
    starts = {part.start for part in ranges}
    for share in shares:
        assert sum(map(len, share)) <= -(-sum(map(len, ranges)) // size) + multiple
        assert all(part.start % multiple == 0 or part.start in starts for part in share)


def test_alone_nothing_is_sent():
    with ranks.process_group() as group:
        assert group == ALONE
    assert ALONE.agree("value") == "value"
    assert not ranks.launched()
    assert ranks.own_device("cuda") == "cuda"
    assert ranks.fair_threads() == torch.get_num_threads()


def test_threads_and_devices_of_a_rank(monkeypatch):
    for name, value in {
        "RANK": 3,
        "WORLD_SIZE": 4,
        "LOCAL_WORLD_SIZE": 2,
        "LOCAL_RANK": 1,
        "MASTER_ADDR": "x",
        "MASTER_PORT": 1,
    }.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(10)))
    assert ranks.fair_threads() == 5
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 8)
    assert ranks.own_device("cuda") == "cuda:1"
    assert ranks.own_device("cuda:5") == "cuda:5"
    assert ranks.own_device("cpu") == "cpu"
    assert ranks.rank_of_environment() == 3
