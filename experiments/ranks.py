"""Two processes, or two threads, in place of one: how much faster is an ensemble, and is it the same to the last bit?"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure

import torchchain as tc
from torchchain import checks
from torchchain.ensemble import ranks

METHODS = ("modes", "chebyshev")
WAYS = {"1 process, 1 thread": (1, 1), "2 processes, 1 thread each": (2, 1), "1 process, 2 threads": (1, 2)}


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """The paper's case with more chains."""

    realizations: int = 200
    """chains in the ensemble"""
    step: float = 1.0
    """time step of the output"""
    strength: float = 0.3
    """disorder xi"""
    repeats: int = 3
    """times that each way is measured, in turn"""
    launch: bool = True
    """processes of their own for each way; without, those of one process alone"""


SMOKE = Config(n_particles=32, n_bands=4, realizations=8, stop=5.0, repeats=1, launch=False)


def timed(config: Config) -> dict[str, Any]:
    """Seconds of the ensemble by each method, on wall and CPU clocks, and a hash of its results."""
    scene, found = config.scene(config.strength), {}
    small = Config(**{**asdict(config), "realizations": 2}).scene(config.strength)
    with ranks.process_group() as group:
        for method in METHODS:
            options = {"accuracy": 1e-10} if method == "chebyshev" else {}
            tc.band_transfer(small, method, long_time=False, options=options, ranks=group)  # loads and compiles
            group.agree(None)  # all begin together
            began, worked = time.perf_counter(), time.process_time()
            transfer = tc.band_transfer(scene, method, long_time=False, options=options, ranks=group)
            found[method] = {
                "seconds": time.perf_counter() - began,
                "cpu_seconds": time.process_time() - worked,
                "digest": hashlib.sha256(
                    transfer.mean.numpy().tobytes() + transfer.stderr.numpy().tobytes()
                ).hexdigest(),
            }
    return found


def work() -> None:
    """In processes of their own: the settings from the environment, what was measured to a file for each rank."""
    case = json.loads(os.environ["TORCHCHAIN_EXPERIMENT"])
    torch.set_num_threads(case["threads"])
    found = timed(Config(**case["config"]))
    Path(case["folder"], f"{os.environ.get('RANK', '0')}.json").write_text(json.dumps(found))


def launched(config: Config, processes: int, threads: int, folder: Path) -> list[dict[str, Any]]:
    """What each process of a way measured."""
    folder.mkdir(parents=True)
    case = json.dumps({"config": asdict(config), "threads": threads, "folder": str(folder)})
    launcher = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        f"--nproc-per-node={processes}",
        "--no-python",
    ]
    done = subprocess.run(
        [*launcher, sys.executable, "-c", "import ranks; ranks.work()"],
        env={**os.environ, "TORCHCHAIN_EXPERIMENT": case, "OMP_NUM_THREADS": str(threads)},
        cwd=Path(__file__).parent, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{processes} processes failed: {done.stderr[-2000:]}")
    return [json.loads(path.read_text()) for path in sorted(folder.iterdir())]


def here(config: Config, threads: int) -> list[dict[str, Any]]:
    """The same in this process."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return [timed(config)]
    finally:
        torch.set_num_threads(before)


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', whose cores this experiment shares out", repr(device))
    ways = {name: way for name, way in WAYS.items() if config.launch or way[0] == 1}
    seconds = np.empty((len(METHODS), len(ways), config.repeats))
    cpu, digests = np.empty_like(seconds), [set() for _ in METHODS]
    with tempfile.TemporaryDirectory() as scratch:
        for repeat in range(config.repeats):
            for w, (processes, threads) in enumerate(ways.values()):
                place = Path(scratch) / f"{repeat}-{w}"
                found = launched(config, processes, threads, place) if config.launch else here(config, threads)
                for m, method in enumerate(METHODS):
                    seconds[m, w, repeat] = max(each[method]["seconds"] for each in found)
                    cpu[m, w, repeat] = sum(each[method]["cpu_seconds"] for each in found)
                    digests[m] |= {each[method]["digest"] for each in found}
    return xarray.Dataset(
        {
            "seconds": (
                ("method", "way", "repeat"),
                seconds,
                {"units": "s", "long_name": "until the last process is done"},
            ),
            "cpu_seconds": (("method", "way", "repeat"), cpu, {"units": "s", "long_name": "of all processes"}),
            "results": ("method", [len(each) for each in digests], {"long_name": "different results"}),
            "processes": ("way", [way[0] for way in ways.values()]),
            "threads": ("way", [way[1] for way in ways.values()]),
        },
        coords={"method": list(METHODS), "way": list(ways)},
    )


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for method in METHODS:
        here = data.sel({"method": method})
        one = here.isel(way=0)
        states = config.realizations * config.n_bands * (int(config.stop / config.step) + 1) * config.n_particles
        rows.append(Row(f"{method}: seconds, {one.way.item()}", float(one.seconds.median())))
        rows.append(
            Row(
                f"{method}: CPU nanoseconds per chain, tone, time and particle",
                1e9 * float(one.cpu_seconds.median()) / states,
            )
        )
        for w in range(1, data.sizes["way"]):
            other = here.isel(way=w)
            ratio = (one.seconds / other.seconds).values
            rows += [
                Row(f"{method}: times faster by {other.way.item()}, median of pairs", float(np.median(ratio)),
                    note=f"{ratio.min():.2f} to {ratio.max():.2f}"),
                Row(f"{method}: CPU seconds, of those of one process", float((other.cpu_seconds / one.cpu_seconds).median())),
            ]  # fmt: skip
        rows.append(Row(f"{method}: different results among all runs", int(here.results) - 1))
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    place = np.arange(data.sizes["way"])
    for ax, kind, label in zip(axes[0], ("seconds", "cpu_seconds"), ("seconds", "CPU seconds in all"), strict=True):
        for m, method in enumerate(METHODS):
            values = data[kind].sel({"method": method})
            ratio = values.isel(way=0) / values if kind == "seconds" else values / values.isel(way=0)
            relative = ratio.transpose("way", "repeat").values
            bars = ax.bar(place + 0.4 * m - 0.2, np.median(relative, axis=1), 0.38, color=f"C{m}", label=method)
            ax.bar_label(bars, fmt="%.2f")
            for repeat in range(data.sizes["repeat"]):
                ax.plot(place + 0.4 * m - 0.2, relative[:, repeat], "k.", ms=3)
        ax.set_xticks(place, [str(way).replace(", ", ",\n") for way in data.way.values])
        ax.set(ylabel="times faster than one thread" if kind == "seconds" else f"{label}, relative to one thread")
    axes[0, 0].axhline(2, color="k", ls=":", lw=1)
    axes[0, 0].set(title="times faster (dots: single runs)", ylim=(0, 2.4))
    axes[0, 1].set(title="work done in all")
    axes[0, 0].legend(loc="upper left", fontsize="small")
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"Band transfer of {config.realizations} chains of {config.n_particles} particles, in turn by each way; starting the processes and\n"
        "compiling are not counted. What passes between processes are settings and, once, the reduced moments. The wall\n"
        "clock shows what else runs on the cores as well; the CPU clock shows whether sharing out costs any work."
    )


SCRIPT = harness.Script("ranks", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
