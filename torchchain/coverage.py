"""Whether a calibrated master equation can take the place of the chains of a scene, and how far off it is then."""

from __future__ import annotations

import math
import time

import torch
from torch import Tensor

from torchchain.bands import band_of
from torchchain.excitation import StandingWave
from torchchain.master import MasterEquation
from torchchain.scene import Scene

PREDICTED = frozenset({"band_energy", "long_time_band_energy"})
TIMED = 64  # times of the trial solution


def gaps(master: MasterEquation, scene: Scene) -> list[str]:
    """What the scene asks for beyond the calibration, in words; empty where the calibration covers it."""
    found = master.concerns(scene)
    other = [name for name in scene.observables if name not in PREDICTED]
    if other:
        found.append(f"{', '.join(other)}, where it predicts energies of bands")
    if not isinstance(scene.excitation, StandingWave):
        found.append("an impulse, calibrated on standing waves")
    return found


def starts(master: MasterEquation, scene: Scene) -> Tensor:
    """A unit energy in the band of each tone, (tone, band)."""
    bands = [band_of(tone, scene.n_particles, scene.n_bands) - 1 for tone in scene.tones]
    return torch.eye(master.n_bands, dtype=torch.float64)[bands]


def error(master: MasterEquation, scene: Scene) -> float | None:
    """Largest standard error of the predicted shares of the energy, or None where the calibration does not tell.

    Without a bootstrap the fit's own test on held-out realizations has to do. Half of the calibrating ensemble was
    predicted from the other half, at the distance h in total variation, two halves being d apart: h^2 - d^2 is the
    model's own error, squared, and the noise of the whole ensemble is d / 2.
    """
    if master.uncertainty is not None:
        return float(master.standard_error(starts(master, scene), scene.times).max())
    held, halves = (master.calibration.report.get(name) for name in ("held_out_distance", "halves_distance"))
    if not isinstance(held, float) or not isinstance(halves, float):
        return None
    return math.sqrt(max(0.0, held**2 - halves**2) + halves**2 / 4)


def seconds(master: MasterEquation, scene: Scene) -> float:
    """Time of a prediction, from a trial solution of up to 64 of its times after one that does not count."""
    rows, some = starts(master, scene), scene.times[-TIMED:]
    spent = 0.0
    for _ in range(2):
        begin = time.perf_counter()
        master.solve(rows, some)
        spent = time.perf_counter() - begin
    return spent * len(scene.times) / len(some)
