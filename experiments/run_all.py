"""Run every script of this folder: python experiments/run_all.py [--smoke] [--out results/experiments]."""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

FOLDER = Path(__file__).resolve().parent
NOT_EXPERIMENTS = ("binary_windows", "gradient_cases", "harness", "readme_numbers", "run_all", "speed_against", "speed_history")


@dataclass(frozen=True)
class Flags:
    """Run every experiment of this folder, one line each; the exit status is 1 if any fails."""

    smoke: tyro.conf.FlagCreatePairsOff[bool] = False
    """seconds instead of minutes, with few chains and short times"""
    out: str = "results/experiments"
    """folder with a folder for each experiment"""
    device: str = "cpu"
    """cpu, cuda, cuda:1, ..."""


def names() -> list[str]:
    """The scripts, found by being there."""
    return sorted(path.stem for path in FOLDER.glob("*.py") if path.stem not in NOT_EXPERIMENTS)


def run_one(name: str, arguments: list[str]) -> tuple[bool, str]:
    """Whether ``main`` of a script succeeds, and its last line or its error."""
    shown, complaints = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(complaints):
            status = importlib.import_module(name).main(arguments)
    except SystemExit as stop:
        status = stop.code
    except Exception:
        return False, traceback.format_exc().strip().splitlines()[-1]
    lines = (complaints if status else shown).getvalue().strip().splitlines()
    return not status, lines[-1] if lines else ""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run them all and return the exit status."""
    flags = tyro.cli(Flags, args=arguments)
    if str(FOLDER) not in sys.path:
        sys.path.insert(0, str(FOLDER))
    failed = 0
    for name in names():
        began = time.perf_counter()
        given = ["--out", str(Path(flags.out) / name), "--device", flags.device] + ["--smoke"] * flags.smoke
        good, line = run_one(name, given)
        failed += not good
        print(f"{'ok    ' if good else 'FAILED'} {name:<20} {time.perf_counter() - began:6.1f} s  {line}", flush=True)
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
