"""Speed from version to version: measure, compare with the last file of experiments/charts, and keep: python experiments/speed_history.py [--keep].

Cases are timed in turn with a piece of plain numpy and torch work, and their processor time is compared in units of it, which other
machines and their load change less than seconds. A case that takes more than 1.3 times its last ratio is named, and the exit status is 1.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

import torchchain as tc

ROOT = Path(__file__).resolve().parent
FRAMES = ROOT.parent / "tests" / "data" / "lammps" / "linear-1-1.dump.gz"
SLOWER = 1.3
PACKAGES = ("torchchain", "torch", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class Flags:
    """Measure, compare with the last, and keep the numbers where asked to."""

    keep: tyro.conf.FlagCreatePairsOff[bool] = False
    """write a file to the folder"""
    repeats: int = 7
    """timings of a case, each beside one of the reference work; medians count"""
    size: int = 1
    """1: some tenths of a second a case; 0: for tests"""
    folder: str = str(ROOT / "charts")
    """of the files"""


def reference() -> None:
    """Work that this library has no part in: some 20 ms of eigenvalues, products and Fourier transforms."""
    values = np.linspace(0, 1, 160 * 160).reshape(160, 160)
    np.linalg.eigvalsh(values + values.T)
    for _ in range(8):
        np.fft.rfft(values @ values, axis=1)
        torch.from_numpy(values).cos().sum()


def cases(size: int) -> dict[str, Callable[[], Any]]:
    """What is timed, by name; everything is loaded and compiled by a first call that does not count."""
    n, chains = (256, 12) if size else (32, 2)
    times = torch.linspace(0, 50, 51, dtype=torch.float64)
    waves = tc.Scene(n_particles=n, n_bands=n // 8, realizations=chains, times=times)
    kick = tc.Scene(
        n_particles=4 * n, boundary="fixed", excitation=tc.Impulse(), observables=("center", "width"), realizations=chains, times=times
    )  # fmt: skip
    masses = tc.Disorder(strength=0.3).masses(4 * n, 1, 0)
    linear, hertz = tc.Chain(masses), tc.Chain(masses, boundary="fixed", contact="hertz")
    wave, tap = tc.standing_wave(linear, tone=n // 4), tc.impulse(hertz, site=1, velocity=0.001)
    lattice = tc.lattice("square", (n // 8, n // 8))
    rest = torch.zeros(lattice.n_particles, 2, dtype=torch.float64)
    push = tc.State(rest, rest.index_fill(0, torch.tensor([0]), 0.01))
    transfer = tc.band_transfer(tc.Scene(n_particles=n, n_bands=n // 8, realizations=20, times=times), method="modes")
    paper = tc.calibrate(transfer, model="paper", method="linear", bootstrap=0)
    late = torch.linspace(0, 500, 501, dtype=torch.float64)
    return {
        "band transfer, chebyshev": lambda: tc.band_transfer(waves, method="chebyshev", long_time=False),
        "band transfer, modes": lambda: tc.band_transfer(waves, method="modes"),
        "kick, center and width": lambda: tc.simulate(kick, method="chebyshev"),
        "one chain, chebyshev": lambda: tc.evolve(linear, wave, times, method="chebyshev"),
        "one chain, Hertz, verlet": lambda: tc.evolve(hertz, tap, times, method="verlet", step=0.05),
        "normal modes": lambda: tc.normal_modes(linear),
        "paper's rates": lambda: tc.paper_rates(transfer),
        "calibrate, compact": lambda: tc.calibrate(transfer, model="compact", bootstrap=0),
        "calibrate, memory": lambda: tc.calibrate(transfer, model="memory", bootstrap=0),
        "predict, 501 times": lambda: paper.transfer(late).detach(),
        "theory": lambda: tc.band_transfer(waves, method="theory"),
        "read a LAMMPS dump": lambda: tc.read_frames(FRAMES).trajectory(),
        "square lattice, chebyshev": lambda: tc.evolve(lattice, push, times, method="chebyshev"),
    }


def measured(flags: Flags) -> dict[str, Any]:
    """Seconds of processor time and ratios to the reference work, with the machine and the versions that they are of."""
    seconds: dict[str, float] = {}
    units: list[float] = []
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for name, run in cases(flags.size).items():
                run()
                spent = []
                for _ in range(flags.repeats):
                    units.append(timed(reference))
                    spent.append(timed(run))
                seconds[name] = statistics.median(spent)
    finally:
        torch.set_num_threads(before)
    unit = statistics.median(units)
    rows = {name: {"seconds": round(spent, 6), "ratio": round(spent / unit, 4)} for name, spent in seconds.items()}
    return {"measured": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "machine": machine(), "size": flags.size, "cases": rows}


def timed(run: Callable[[], Any]) -> float:
    """Processor time of a call."""
    began = time.process_time()
    run()
    return time.process_time() - began


def machine() -> dict[str, Any]:
    """Processor, cores, system and versions."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text(encoding="utf-8").splitlines() if line.startswith("model name")]
        model = names[0] if names else model
    versions = {name: metadata.version(name) for name in PACKAGES[1:]}
    return {
        "processor": model, "cores": os.cpu_count(), "system": platform.system(), "python": platform.python_version(),
        "torchchain": tc.__version__, **versions,
    }  # fmt: skip


def last(folder: Path, size: int) -> tuple[str, dict[str, Any]] | None:
    """The newest file of this size and its name; None where there is none."""
    found = []
    for path in folder.glob("speed_*.json"):
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["size"] == size:
            found.append((data["measured"], path.name, data))
    return max(found)[1:] if found else None


def compared(now: dict[str, Any], before: dict[str, Any]) -> list[tuple[str, float | None]]:
    """For every case its ratio over that of the other file; None for one that is new."""
    old = before["cases"]
    return [(name, row["ratio"] / old[name]["ratio"] if name in old else None) for name, row in now["cases"].items()]


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, compare, keep; the exit status is 1 if a case has become slower."""
    flags = tyro.cli(Flags, args=arguments, description=__doc__)
    folder, now = Path(flags.folder), measured(flags)
    found = last(folder, flags.size)
    changes = dict(compared(now, found[1])) if found else {}
    slower = [name for name, change in changes.items() if change is not None and change > SLOWER]
    width = max(map(len, now["cases"]))
    print(f"{'case':<{width}}  seconds   of the reference" + (f"   of {found[0]}" if found else ""))
    for name, row in now["cases"].items():
        change = changes.get(name)
        told = "" if change is None else f"   {change:.2f}{' SLOWER' if name in slower else ''}"
        print(f"{name:<{width}}  {row['seconds']:<8.4f}  {row['ratio']:<16.3f}{told}")
    if found and found[1]["machine"] != now["machine"]:
        other = found[1]["machine"]
        print("the machine was: " + ", ".join(f"{k} {v}" for k, v in other.items() if now["machine"].get(k) != v))
    if flags.keep:
        folder.mkdir(parents=True, exist_ok=True)
        stamp = now["measured"].replace(":", "").replace("-", "")
        path = folder / f"speed_{tc.__version__}_{stamp}.json"
        path.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
        print(f"kept in {path}")
    return int(bool(slower))


if __name__ == "__main__":
    sys.exit(main())
