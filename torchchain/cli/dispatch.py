"""Run the command that the flags belong to."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.cli import flags as known
from torchchain.cli.calibrate import run_calibrate, seconds_of_starts
from torchchain.cli.compare import run_compare
from torchchain.cli.family import run_family
from torchchain.cli.imports import run_convert, run_import
from torchchain.cli.predict import run_predict
from torchchain.cli.rerun import rerun
from torchchain.cli.runs import config_of, scene_of, threads_for
from torchchain.cli.simulate import run_simulate
from torchchain.cli.sweep import run_sweep
from torchchain.ensemble.plan import STAND_INS
from torchchain.ensemble.starts import measurable
from torchchain.master.stand_in import plan


def run_plan(flags: known.Plan, arguments: list[str]) -> None:
    """Print the plan of a scene."""
    config, _ = config_of(flags.config, flags.plugin)
    calibration = config.pop("calibration", {})  # the config of a calibration says what is to be planned
    found = plan(scene_of(config, flags), artifact=flags.artifact)
    print(found)
    scene = found.scene
    starts = checks.truth("calibration.starts", calibration.get("starts", True))
    one_a_band = isinstance(scene.excitation, StandingWave) and len(scene.tones) == scene.n_bands
    if starts and one_a_band and found.method not in STAND_INS and measurable(scene):
        how = {"method": found.method, "method_options": json.dumps(found.run_options)}
        print(f"a calibration measures other starts as well: {seconds_of_starts(scene, how):.2g} s more predicted")


RUNS: dict[type, Callable[[Any, list[str]], int | None]] = {
    known.Simulate: run_simulate, known.Calibrate: run_calibrate, known.Predict: run_predict, known.Family: run_family,
    known.Plan: run_plan, known.Rerun: rerun, known.Compare: run_compare, known.Sweep: run_sweep,
    known.Import: run_import, known.Convert: run_convert,
}  # fmt: skip


def run(flags: Any, arguments: list[str]) -> int:
    """Run the command that the flags belong to; returns the exit status."""
    with threads_for(getattr(flags, "threads", None)):
        return RUNS[type(flags)](flags, arguments) or 0
