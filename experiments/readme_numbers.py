"""The numbers of README.md and docs/ made again: python experiments/readme_numbers.py [--all] [--out results/readme].

Each number has the words around it, the command that measures it, and bounds that allow for the machine
(ratios of times) or for the ensemble's error (distances). A word that is no longer there fails, too.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
import xarray

import torchchain as tc
from torchchain.cli import outputs

FOLDER = Path(__file__).resolve().parent
Read = Callable[[Path], float]


@dataclass(frozen=True)
class Flags:
    """Run the commands beside the README's numbers and compare; the exit status is 1 if a number does not hold."""

    all: tyro.conf.FlagCreatePairsOff[bool] = False
    """also what takes minutes to hours"""
    seed: int = 0
    """seed of the ensembles"""
    out: str = "results/readme"
    """folder with a folder for each command"""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """take finished runs that it already holds, of whatever version"""


@dataclass(frozen=True)
class Number:
    """A number of the README: the words that state it, the command, how it is read, and what it may be."""

    said: str
    command: str
    read: Read
    low: float
    high: float
    fast: bool = False
    seeds: int = 1
    """it holds for so many seeds, the first being that asked for"""


def row(*parts: str) -> Read:
    """The (smallest) measured number of the rows of an experiment's table in whose names all the parts are."""

    def read(out: Path) -> float:
        with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as data:
            names, measured = data.row_quantity.values, data.row_measured.values
        found = [float(m) for name, m in zip(names, measured, strict=True) if all(part in str(name) for part in parts)]
        if not found:
            raise LookupError(f"no row with {' and '.join(parts)} in {out}")
        return min(found)

    return read


def distance_over_noise(out: Path) -> float:
    """Of the headline run: late total variation of model and ensemble, over that of two such ensembles."""
    run = tc.open(out)
    late = run.transfer.times > float(run.transfer.times[-1]) / 2
    predicted = run.master.transfer(run.transfer.times)
    distance = tc.total_variation(predicted, run.transfer.mean)[:, late].mean()
    return float(distance / tc.statistical_distance(run.transfer.stderr)[:, late].mean())


def megabytes(out: Path) -> float:
    return sum(path.stat().st_size for path in out.iterdir()) / 1e6


def markov_ratio(out: Path) -> float:
    """T(2 lag) and T(lag)^2: distance over noise, at the lag where it is largest."""
    with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as data:
        lags = range(data.sizes["lag"]) if "distance_1" in data else [0]
        kept = [i for i in lags if f"distance_{i}" in data]
        return max(float((data[f"distance_{i}"][:, 0] / data[f"statistical_{i}"][:, 0]).mean()) for i in kept)


def chains(way: str) -> Read:
    """Chains that a way of drawing them needs for the same error of the squared width, those of plain ones being 1."""

    def read(out: Path) -> float:
        return float((row("width", f"{way}:")(out) / row("width", "plain:")(out)) ** 2)

    return read


HEADLINE = "torchchain calibrate"
NUMBERS = (
    Number("calibrates a master equation and compares the two", HEADLINE, distance_over_noise, 0.3, 1.0, True),
    Number("It leaves in `results/calibrate`", HEADLINE, megabytes, 0.5, 5.0, True),
    Number("**0.0098** for the model", "quality", row("chosen"), 0.009, 0.0125, True),
    Number("0.0112 for the 100 chains", "quality", row("100 chains"), 0.009, 0.0135, True),
    Number("0.29 for the paper's model", "quality", row("procedure L"), 0.26, 0.32, True),
    Number("the theory with none (0.0069)", "few_numbers", row("xi = 0.3: theory"), 0.006, 0.0078),
    Number("ξ = 0.1 (0.0042)", "few_numbers", row("xi = 0.1: theory"), 0.0036, 0.0048),
    Number("T(2 t) differs from T(t)^2 by 29 to 36 times the noise", "markov_tests", markov_ratio, 20.0, 45.0, True),
    Number("0.70 times as fast", "transfer_speed", row("modes: times faster than the recipe"), 0.5, 3.0, True),
    Number("6.7 times faster than chain by chain", "transfer_speed", row("stencil: times faster than the recipe"), 5.0, 15.0, True),
    Number("procedure L 0.29", "calibration_methods", row("linear: paper"), 0.26, 0.32),
    Number("Adam on Q 0.095", "calibration_methods", row("adam, exact: paper"), 0.08, 0.11),
    Number("`memory` 0.015", "calibration_methods", row("projection: memory"), 0.013, 0.020),
    Number("90 of 100 varied scenes", "plan_grid", row("choice takes at most 1.5"), 0.90, 1.0),
    Number("in all it keeps to the", "plan_grid", row("keeps to the tolerance"), 1.0, 1.0),
    Number("0.14 to 0.24 times the chains, by seed", "chart_ensemble", chains("opposite masses"), 0.12, 0.28, seeds=3),
    Number("shifted starts 0.93 to 1.3 times", "chart_ensemble", chains(" starts"), 0.9, 1.35, seeds=3),
)  # fmt: skip


def documents() -> str:
    """README.md and docs/*.md as one line, so that a number may move from one to another."""
    root = FOLDER.parent
    texts = (path.read_text(encoding="utf-8") for path in (root / "README.md", *sorted((root / "docs").glob("*.md"))))
    return " ".join(" ".join(texts).split())


def made(command: str, out: Path, seed: int) -> Path:
    """The folder that the command leaves, made anew."""
    given = ["--seed", str(seed), "--out", str(out)]
    if command == HEADLINE:
        words = [sys.executable, "-m", "torchchain", "calibrate", *given]
    else:
        words = [sys.executable, str(FOLDER / f"{command}.py"), *given]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr.strip()}")
    return out


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print one line for each number, and return the exit status."""
    flags = tyro.cli(Flags, args=arguments)
    readme = documents()
    asked = [number for number in NUMBERS if flags.all or number.fast]
    folders: dict[tuple[str, int], Path] = {}
    failed = 0
    for number in asked:
        values = []
        for seed in range(flags.seed, flags.seed + number.seeds):
            if (number.command, seed) not in folders:
                folder = Path(flags.out) / f"{number.command.split()[-1]}-{seed}"
                finished = flags.resume and (folder / outputs.RECORD).is_file()
                folders[number.command, seed] = folder if finished else made(number.command, folder, seed)
            values.append(number.read(folders[number.command, seed]))
        stated = number.said in readme
        good = stated and all(number.low <= value <= number.high for value in values)
        failed += not good
        verdict = "ok" if good else "NOT STATED" if not stated else "FAILS"
        found = ", ".join(f"{value:.4g}" for value in values)
        print(f"{verdict:<13} {found:<20} {number.low:g} to {number.high:g}  {number.said}", flush=True)
    if not flags.all:
        print(f"{len(NUMBERS) - len(asked)} more with --all")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
