"""Run the command that the flags belong to."""

from __future__ import annotations

from typing import Any

from torchchain.cli import plugins
from torchchain.cli.calibrate import run_calibrate
from torchchain.cli.compare import run_compare
from torchchain.cli.family import run_family
from torchchain.cli.flags import (
    Calibrate,
    Compare,
    Convert,
    Family,
    Import,
    Plan,
    Predict,
    Rerun,
    Simulate,
    Sweep,
)
from torchchain.cli.imports import run_convert, run_import
from torchchain.cli.predict import run_predict
from torchchain.cli.rerun import rerun
from torchchain.cli.runs import config_of, scene_of, threads_for
from torchchain.cli.simulate import run_simulate
from torchchain.cli.sweep import run_sweep
from torchchain.master.stand_in import plan


def run(flags: Any, arguments: list[str]) -> int:
    """Run the command that the flags belong to; returns the exit status."""
    if isinstance(flags, Rerun):
        with threads_for(flags.threads):
            return rerun(flags)
    if isinstance(flags, Simulate):
        with threads_for(flags.threads):
            run_simulate(flags, arguments)
    elif isinstance(flags, Calibrate):
        with threads_for(flags.threads):
            run_calibrate(flags, arguments)
    elif isinstance(flags, Predict):
        run_predict(flags, arguments)
    elif isinstance(flags, Compare):
        run_compare(flags, arguments)
    elif isinstance(flags, Import):
        run_import(flags, arguments)
    elif isinstance(flags, Convert):
        run_convert(flags)
    elif isinstance(flags, Sweep):
        with threads_for(flags.threads):
            run_sweep(flags, arguments)
    elif isinstance(flags, Family):
        plugins.load(())
        run_family(flags, arguments)
    elif isinstance(flags, Plan):
        config, _ = config_of(flags.config, flags.plugin)
        config.pop("calibration", None)  # the config of a calibration says what is to be planned
        print(plan(scene_of(config, flags), artifact=flags.artifact))
    return 0
