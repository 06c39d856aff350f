"""A calibrated master equation in the place of the chains of a scene: whether it can stand in, and how far off it is then."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.energy.start_energy import StartEnergy, excited
from torchchain.ensemble import plan as planning
from torchchain.ensemble.plan import ARTIFACT, Choice, Plan, statistical_error
from torchchain.ensemble.scene import Scene
from torchchain.master.derived import THEORY, covered
from torchchain.master.equation import MasterEquation
from torchchain.theory.transfer import predicted_error


def missing(master: MasterEquation, scene: Scene) -> list[str]:
    """What the scene asks for beyond the calibration, in words; empty where the calibration covers it."""
    found = master.concerns(scene)
    other = [name for name in scene.observables if name not in master.model.predicts]
    if other:
        found.append(f"{', '.join(other)}, where it predicts energies of bands")
    return found


def starts(master: MasterEquation, scene: Scene) -> Tensor | StartEnergy:
    """A unit energy in the band of each tone, (tone, band); of a model of any start, that of the scene, of energy 1 each."""
    if master.starts is not None:
        wave = scene.excitation
        wave = replace(wave, tones=scene.tones) if isinstance(wave, StandingWave) else wave
        return excited(wave, scene.n_particles).of_unit_energy()
    return torch.eye(master.n_bands, dtype=torch.float64)[[band - 1 for band in scene.source_bands]]


def error(master: MasterEquation, scene: Scene) -> float | None:
    """Largest standard error of the predicted shares of the energy, or None where the calibration does not tell.

    Without a bootstrap the fit's own test on held-out realizations has to do. Half of the calibrating ensemble was
    predicted from the other half, at the distance h in total variation, two halves being d apart: h^2 - d^2 is the
    model's own error, squared, and the noise of the whole ensemble is d / 2.
    """
    if master.uncertainty is not None:
        return float(master.standard_error(starts(master, scene), scene.times).max())
    selection = master.calibration.report.selection
    if selection is None or selection.held_out_distance is None or selection.halves_distance is None:
        return None
    held, halves = selection.held_out_distance, selection.halves_distance
    return math.sqrt(max(0.0, held**2 - halves**2) + halves**2 / 4)


def cost(master: MasterEquation, scene: Scene) -> float:
    """Seconds of a prediction on the plan's nominal core: the propagators of all times, applied to all starts."""
    n, times = master.n_bands, len(scene.times)
    return 2e-3 + times * (1e-5 + 2e-10 * n**3 + 1e-9 * n**2 * len(scene.tones))


def plan(scene: Scene, artifact: str | Path | MasterEquation | None = None) -> Plan:
    """The cheapest way to a scene whose predicted error is within its tolerance.

    Without a tolerance the method's error may be a third of the statistical error of the ensemble, to which it adds
    5 %: a finer integrator would be waste. Errors come from each method's own theory, costs from counted work on a
    nominal core, so that a scene has one plan on every machine and at every time.

    Args:
        scene: what is wanted.
        artifact: a calibrated master equation, or its file or folder, that could take the place of the chains.

    Returns:
        Plan, whose ``str`` is the table that ``torchchain plan`` prints.

    Raises:
        FieldError: if no method can treat the scene, or none reaches the tolerance.

    Example:
        >>> plan = tc.plan(tc.Scene(n_particles=64, n_bands=8, tolerance=1e-6))
        >>> plan.predicted_error <= 1e-6, plan.dtype
        (True, torch.float64)
    """
    return planning.plan(scene, partial(_stand_ins, artifact=artifact))


def _stand_ins(
    scene: Scene, tolerance: float, artifact: str | Path | MasterEquation | None
) -> tuple[list[Choice], list[str]]:
    """The artifact at hand, if there is one, and the theory."""
    choices, remarks = ([], []) if artifact is None else _stand_in(scene, tolerance, artifact)
    derived, told = _theory(scene, tolerance)
    return [*choices, *derived], [*told, *remarks]


def _theory(scene: Scene, tolerance: float) -> tuple[list[Choice], list[str]]:
    """The theory of disorder, where it covers the scene and its estimated error is within what is allowed.

    Where no tolerance is asked for, it is told of if it is nearer to an endless ensemble than the scene's is, but not chosen.
    """
    if (
        not THEORY.kind.predicts.issuperset(scene.observables)
        or not isinstance(scene.excitation, StandingWave)
        or scene.is_ordered
    ):
        return [], []
    try:
        law, waves = covered(scene)
    except checks.FieldError:
        return [], []
    allowed = tolerance if scene.tolerance is not None else statistical_error(scene)
    expected = float(predicted_error(law, waves, scene.times).max())
    if expected > allowed:
        return [], []
    n, times, sources = scene.n_bands, len(scene.times), len(scene.tones)
    work = 0.1 + sources * (4e-3 + n * (2e-4 + 2e-6 * times))
    told = (
        f"no chains needed: theory gives the energies of bands to {expected:.1e}, {allowed:.1e} allowed "
        '(band_transfer(scene, method="theory"))'
    )
    choice = Choice(planning.THEORY, {}, expected, work, work * planning.speed(), allowed)
    return [choice] if scene.tolerance is not None else [], [told]


def _stand_in(scene: Scene, tolerance: float, artifact: str | Path | MasterEquation) -> tuple[list[Choice], list[str]]:
    """A prediction in place of the chains, if the calibration covers the scene, and what is to be said of it.

    Its error holds the noise of its own ensemble, which takes the place of the scene's: without a tolerance it may be
    as large as that.
    """
    checks.instance("artifact", artifact, str, Path, MasterEquation)
    master = artifact if isinstance(artifact, MasterEquation) else MasterEquation.load(artifact)
    beyond = missing(master, scene)
    if beyond:
        return [], [f"the master equation at hand does not cover the scene: {'; '.join(beyond)}"]
    expected = error(master, scene)
    if expected is None:
        return [], ["the master equation at hand covers the scene, but its calibration does not tell its error"]
    allowed = tolerance if scene.tolerance is not None else statistical_error(scene)
    work = cost(master, scene)
    choice = Choice(ARTIFACT, {}, expected, work, work * planning.speed(), allowed)
    verdict = "accurate enough" if choice.good else "not accurate enough"
    return [choice], [
        f"the master equation at hand covers the scene and is {verdict}: its shares of the energy are good to "
        f"{expected:.1e}, {allowed:.1e} allowed"
    ]
