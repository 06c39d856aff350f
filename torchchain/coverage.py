"""Whether a calibrated master equation can take the place of the chains of a scene, and how far off it is then."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import torch

from torchchain.excitation import StandingWave
from torchchain.master import MasterEquation
from torchchain.scene import Scene

SAME = ("n_particles", "boundary", "n_bands", "disorder", "stiffness_disorder", "contact", "damping", "energy_definition")
TIMED = 64  # times of the trial solution


def gaps(master: MasterEquation, scene: Scene) -> list[str]:
    """What the scene asks for beyond the calibration, in words; empty where the calibration covers it."""
    made = master.calibration.scene
    found = [
        f"{name} {_shown(getattr(scene, name))} instead of {_shown(getattr(made, name))}"
        for name in SAME
        if getattr(scene, name) != getattr(made, name)
    ]
    other = [name for name in scene.observables if name != "band_energy"]
    if other:
        found.append(f"observables {', '.join(other)}, which it does not predict")
    if not isinstance(scene.excitation, StandingWave):
        found.append("an impulse instead of standing waves")
    elif set(scene.tones) - set(made.tones):
        found.append("tones other than those it was calibrated with")
    end, horizon = float(scene.times[-1]), float(made.times[-1])
    if end > horizon:
        found.append(f"times to {end:g}, calibrated to {horizon:g}")
    return found


def _shown(value: object) -> str:
    strength = getattr(value, "strength", None)
    return f"{value}" if strength is None else f"{getattr(value, 'kind', '')} {strength:g}"


def error(master: MasterEquation) -> float | None:
    """Distance of a prediction from the infinite ensemble, in total variation, or None where the calibration does not tell.

    Half of the calibrating ensemble was predicted from the other half, at the distance h, two halves being d apart:
    h^2 - d^2 is the model's own error, squared, and the whole ensemble's noise is d / 2.
    """
    report: Mapping[str, object] = master.calibration.report
    held, halves = report.get("held_out_distance"), report.get("halves_distance")
    if not isinstance(held, float) or not isinstance(halves, float):
        return None
    return math.sqrt(max(0.0, held**2 - halves**2) + halves**2 / 4)


def seconds(master: MasterEquation, scene: Scene) -> float:
    """Time of a prediction, from a trial solution of up to 64 of its times after one that does not count."""
    rows = torch.eye(master.n_bands, dtype=torch.float64)[: max(1, len(scene.tones))]
    some = scene.times[-TIMED:]
    for _ in range(2):
        begin = time.perf_counter()
        master.solve(rows, some)
        spent = time.perf_counter() - begin
    return spent * len(scene.times) / len(some)
