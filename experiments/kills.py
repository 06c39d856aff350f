"""Runs killed (SIGKILL) at random moments and started again until they are done: are the results the same bits?"""

from __future__ import annotations

import multiprocessing
import os
import sys
import tempfile
import time
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure
from safetensors.torch import load_file

from torchchain import checks, cli
from torchchain.ensemble.statistics import EnsembleMoments, joined

N_BLOCKS = {"simulate": 1, "calibrate": 20}


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the ensembles and of the moments of the kills"""
    commands: tuple[str, ...] = tuple(N_BLOCKS)
    """the commands that are killed"""
    kills: int = 100
    """kills in all, as many of each command"""
    realizations: int = 600
    """chains of an ensemble"""
    n_particles: int = 64
    """particles per chain"""
    n_bands: int = 8
    """wavenumber bands"""
    stop: float = 20.0
    """last time"""
    every: float = 0.1
    """seconds between saves"""


SMOKE = Config(commands=("calibrate",), kills=1, realizations=40, n_particles=16, n_bands=2, stop=3.0, every=0.0)


def arguments(config: Config, command: str, out: Path) -> list[str]:
    flags = {
        "--n-particles": config.n_particles, "--n-bands": config.n_bands, "--realizations": config.realizations,
        "--times.stop": config.stop, "--seed": config.seed, "--checkpoint-every": config.every, "--method": "modes",
        "--out": out,
    }  # fmt: skip
    if command == "calibrate":
        flags["--fit"] = "linear"
    return [command, *(str(word) for pair in flags.items() for word in pair)]


SERVER = multiprocessing.get_context("forkserver")  # forks processes that hold the libraries already
SERVER.set_forkserver_preload(["torchchain.cli.dispatch", "torchchain.evolvers.stencil", "matplotlib.backends.backend_agg", "xarray", "__main__"])


def _run(command: list[str]) -> None:
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    torch.set_num_threads(1)
    os._exit(cli.main(command))


def begun(command: list[str]) -> BaseProcess:
    """The command in a process of its own."""
    process = SERVER.Process(target=_run, args=(command,))
    process.start()
    return process


def ended(process: BaseProcess, seconds: float) -> bool:
    """Whether the process ends by itself within so many seconds."""
    process.join(seconds)
    if process.exitcode:
        raise RuntimeError(f"a run failed with status {process.exitcode}")
    return process.exitcode == 0


def kept(config: Config, command: str, out: Path) -> tuple[int, float, int]:
    """Realizations in the checkpoint of a run, the time of its last save, and its size in bytes."""
    held: list[range] = []
    last, size = 0.0, 0
    for part in (out / "checkpoint").glob("*.safetensors"):
        moments = EnsembleMoments.from_tensors(config.realizations, N_BLOCKS[command], load_file(part))
        held += moments.held()
        last, size = max(last, part.stat().st_mtime), size + part.stat().st_size
    return sum(map(len, joined(held))), last, size


def contents(out: Path) -> dict[str, bytes]:
    """All data that a run left."""
    found = {path.name: path.read_bytes() for path in out.glob("*.safetensors")}
    for path in out.glob("*.nc"):
        with xarray.open_dataset(path, engine="h5netcdf") as data:
            found |= {str(name): values.values.tobytes() for name, values in data.load().variables.items()}
    return found


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu" or not hasattr(os, "fork"):
        raise checks.fail("device", "be 'cpu', on a system that can fork", device)
    for command in config.commands:
        checks.choice("commands", command, N_BLOCKS)
    if config.kills < len(config.commands):
        raise checks.fail("kills", "be at least one of each command", config.kills)
    random = np.random.default_rng(config.seed)
    kills: list[tuple[float, ...]] = []
    jobs: list[tuple[float, ...]] = []
    with tempfile.TemporaryDirectory() as scratch:
        for command in config.commands if config != SMOKE else ():  # the first processes load what is loaded late
            ended(begun(arguments(SMOKE, command, Path(scratch) / "first")), 3600.0)
        for index, command in enumerate(config.commands):
            whole = Path(scratch) / command
            begin = time.monotonic()
            if not ended(begun(arguments(config, command, whole)), 3600.0):
                raise RuntimeError("the undisturbed run took more than an hour")
            duration, reference = time.monotonic() - begin, contents(whole)
            wanted = len(kills) + config.kills // len(config.commands)
            while len(kills) < wanted:
                out, before = Path(scratch) / f"{command}-{len(jobs)}", len(kills)
                while True:
                    start = time.time()
                    child = begun(arguments(config, command, out))
                    if ended(child, random.uniform(0, duration) if len(kills) < wanted else 3600.0):
                        break
                    child.kill()
                    child.join()
                    now = time.time()
                    count, saved, size = kept(config, command, out)
                    kills.append((index, len(jobs), now - start, now - max(saved, start), count, size))
                left = {path.name for path in out.iterdir()} | {path.name for path in out.parent.glob(f".{out.name}.*")}
                clean = left == {path.name for path in whole.iterdir()}
                jobs.append((index, len(kills) - before, contents(out) == reference, clean, duration))
    k, j = np.array(kills).T, np.array(jobs).T
    return xarray.Dataset(
        {
            "kill_command": ("kill", k[0].astype(int)),
            "kill_job": ("kill", k[1].astype(int)),
            "seconds": ("kill", k[2], {"units": "s", "long_name": "from the start of the process to its kill"}),
            "lost": ("kill", k[3], {"units": "s", "long_name": "from the last save, or the start, to the kill"}),
            "kept": ("kill", k[4].astype(int), {"long_name": "realizations in the checkpoint"}),
            "size": ("kill", k[5].astype(int), {"units": "byte"}),
            "job_command": ("job", j[0].astype(int)),
            "job_kills": ("job", j[1].astype(int)),
            "equal": ("job", j[2].astype(int), {"long_name": "whether all data equal those of the undisturbed run"}),
            "clean": ("job", j[3].astype(int), {"long_name": "whether nothing but the results is left"}),
            "undisturbed": ("job", j[4], {"units": "s", "long_name": "time of the undisturbed run"}),
        },
        attrs={"commands": " ".join(config.commands)},
    )


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [
        Row("kills", data.sizes["kill"]),
        Row("runs that were killed and went on", data.sizes["job"]),
        Row("of these with all data equal to the last bit", int(data.equal.sum())),
        Row("of these that left nothing but their results", int(data.clean.sum())),
        Row("most kills of one run", int(data.job_kills.max())),
    ]
    for index, command in enumerate(config.commands):
        here = data.kill_command == index
        lost, size = data.lost.values[here], data["size"].values[here]
        rows += [
            Row(f"{command}: seconds, undisturbed", float(data.undisturbed.values[data.job_command == index][0])),
            Row(f"{command}: seconds lost in a kill, median", float(np.median(lost))),
            Row(f"{command}: seconds lost in a kill, most", float(lost.max())),
            Row(f"{command}: megabytes of checkpoint, most", float(size.max()) / 1e6),
        ]
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    lost, kept = axes[0]
    edges = np.linspace(0, max(1e-3, float(data.lost.max())) * 1.001, 25)
    for index, command in enumerate(config.commands):
        values = data.lost.values[data.kill_command == index]
        lost.hist(values, edges, alpha=0.6, color=f"C{index}", label=f"{command}, {len(values)} kills")
        first = True
        for job in np.flatnonzero(data.job_command.values == index):
            here = data.kill_job.values == job
            steps = np.concatenate([[0], data.kept.values[here], [config.realizations]])
            kept.plot(
                np.arange(len(steps)), steps, ".-", color=f"C{index}", alpha=0.6, label=command if first else None
            )
            first = False
    lost.axvline(config.every, color="k", ls=":", label=f"seconds between saves, {config.every:g}")
    lost.set(xlabel="work lost in a kill (s)", ylabel="kills", title="from the last save, or the start, to the kill")
    lost.legend(fontsize="small")
    kept.set(
        xlabel="kills of a run so far (last: done)", ylabel="realizations kept", title="every run comes to its end"
    )
    kept.xaxis.get_major_locator().set_params(integer=True)
    kept.legend(fontsize="small")
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        "Each run is killed at a random moment and the same command given again, until it is done; then all data are\n"
        "compared with those of a run that nothing disturbed. What a kill loses is what came after the last save: the time\n"
        "between saves and a chunk; in calibrate also the fit, which is made anew from the finished ensemble. The moments of\n"
        "the kills are random in time: another machine kills elsewhere. A line that falls to 0 was killed between its results and\n"
        "its end: the results are there, the checkpoint is gone, and the command makes them anew."
    )


SCRIPT = harness.Script("kills", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
