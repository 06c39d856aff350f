"""Run the command that the flags belong to."""

from __future__ import annotations

from typing import Any

from torchchain.cli.calibrate import run_calibrate
from torchchain.cli.family import run_family
from torchchain.cli.flags import Calibrate, Family, Plan, Predict, Rerun, Simulate
from torchchain.cli.predict import run_predict
from torchchain.cli.rerun import rerun
from torchchain.cli.runs import scene_of, threads_for
from torchchain.cli.simulate import run_simulate
from torchchain.master.stand_in import plan


def run(flags: Any, arguments: list[str]) -> int:
    """Run the command that the flags belong to; returns the exit status."""
    if isinstance(flags, (Simulate, Calibrate, Rerun)):
        with threads_for(flags.threads):
            if isinstance(flags, Simulate):
                run_simulate(flags, arguments)
            elif isinstance(flags, Calibrate):
                run_calibrate(flags, arguments)
            else:
                return rerun(flags)
    elif isinstance(flags, Predict):
        run_predict(flags, arguments)
    elif isinstance(flags, Family):
        run_family(flags, arguments)
    elif isinstance(flags, Plan):
        print(plan(scene_of(flags)[0], artifact=flags.artifact))
    return 0
