"""The band transfer of a scene: measured on simulated chains or lattices, or from theory without any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.ensemble import plan as planning
from torchchain.ensemble.block_means import rounded
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.layout import BLOCKS
from torchchain.ensemble.mixed_starts import unmixed
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.run import ensemble_moments
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.starts import measurable, start_transfer
from torchchain.ensemble.statistics import EnsembleMoments
from torchchain.ensemble.transfer import BandTransfer
from torchchain.ensemble.transfer_fields import late_average, of_moments
from torchchain.theory.lattices import lattice_transfer
from torchchain.theory.law import law_of
from torchchain.theory.transfer import theory_transfer
from torchchain.threads import beside, single_thread

THEORY = "theory"
"""The method of a transfer without chains."""
MOST_UNKNOWNS = 1500
"""Of lattices whose long-time average is taken from all modes; beyond it from the later half of the times."""


def band_transfer(
    scene: Scene,
    method: str = "auto",
    long_time: bool = True,
    *,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
    starts: bool = True,
) -> BandTransfer:
    """The transfer of energy from every band to every band: one standing wave per band, averaged over the ensemble.

    Of lattices, one plane wave per shell of |q| and polarization.

    Args:
        scene: standing waves with one tone in each of its bands, or none given (the bands' center tones).
        method: a name of ``evolvers.METHODS``; "auto" for the plan's choice; or "theory" for band energies without chains
            (see :func:`torchchain.theory.theory_transfer`): no statistical error, ``systematic`` as its own estimate; of
            scalar lattices (:func:`torchchain.theory.lattice_transfer`) without that and without a long-time average.
        long_time: also take the exact infinite-time average from the modes; damped chains have none. Of lattices with more
            than 1500 unknowns it is the mean over the later half of the times, whose error counts what has not settled.
        device, memory_budget, progress, stages, options: see :func:`stream`.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.
        ranks: processes that share the realizations, from :func:`torchchain.ensemble.ranks.process_group`; each gets the result.
        starts: also measure the transfer from other tones of each band and from kicks, of undamped, linear rings with 16 samples
            and more: a model calibrated on it takes any start in space. It adds about two thirds to the cost.

    Returns:
        BandTransfer with mean and stderr [source, time, receiver].

    Raises:
        FieldError: if the excitation is no standing wave, or a band has not exactly one tone.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=20, times=[0.0, 5.0, 50.0])
        >>> transfer = tc.band_transfer(scene, method="modes")
        >>> transfer.mean[3, :, 3].diff().lt(0).tolist()  # the energy of a source band falls
        [True, True]
    """
    checks.truth("long_time", long_time)
    checks.truth("starts", starts)
    scene, stages = _transfer_scene(planning.resolved(scene)), stages or Stages()
    if checks.choice("method", method, ("auto", *scene.methods, THEORY)) == THEORY:
        checks.known_keys("options of method 'theory'", options or {}, ())
        with stages("theory"):
            return _from_theory(scene, long_time and scene.largest_damping == 0)
    long_time = long_time and scene.largest_damping == 0
    observables = measured_observables(scene, long_time)
    settings: dict[str, Any] = {
        "device": device, "memory_budget": memory_budget, "progress": progress, "stages": stages, "ranks": ranks,
    }  # fmt: skip
    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    ensemble = ensemble_moments(
        replace(scene, observables=observables), method,
        min(BLOCKS, scene.distinct_realizations // scene.sample_size), options=options, checkpoint=checkpoint, **settings,
    )  # fmt: skip

    def measured() -> BandTransfer:
        with single_thread(), stages("statistics"):
            found = BandTransfer(**of_moments(scene, scene.times, ensemble.moments, ensemble.attributes, None))
            found = _by_species(found, ensemble.moments) if scene.by_species else found
            return with_late_average(found) if long_time and len(observables) == 1 else found

    if not starts or not measurable(scene):
        return measured()
    other = None if checkpoint is None else Checkpoint(checkpoint.folder / "starts", checkpoint.every)
    with beside(measured, torch.get_num_threads(), at_once=True) as found:
        moved = start_transfer(scene, ensemble.method, ensemble.options, other, **settings)
    return replace(found(), starts=moved)


def _by_species(transfer: BandTransfer, moments: EnsembleMoments) -> BandTransfer:
    """The transfer between the species' bands, from runs whose waves are seen in several of them at the start."""
    if float(transfer.times[0]) != 0:
        raise checks.fail("times", "begin at 0 for the transfer between species", float(transfer.times[0]))
    blocks = moments.blocks("band_energy")
    try:
        found = unmixed(torch.stack([block.mean for block in blocks]), [block.count for block in blocks])
    except checks.FieldError as error:
        rule = "tell k from pi - k for the transfer between species (random or blocks, with species mixed enough)"
        raise checks.fail("arrangement", rule, str(error)) from None
    stderr = torch.zeros_like(found.stderr) if transfer.is_ordered else found.stderr
    block_mean, stderr = rounded(found.block_mean, found.mean, stderr, found.block_counts)
    attributes = transfer.attributes | {"start_condition": found.condition}
    return replace(transfer, mean=found.mean, stderr=stderr, block_mean=block_mean, attributes=attributes)


def measured_observables(scene: Scene, long_time: bool = True) -> tuple[str, ...]:
    """What is measured on every realization of a band transfer: of large lattices no long-time average, which takes all modes."""
    exact = scene.lattice is None or scene.n_particles * scene.n_components <= MOST_UNKNOWNS
    exact = exact and long_time and not scene.by_species and scene.largest_damping == 0
    return ("band_energy", "long_time_band_energy") if exact else ("band_energy",)


def with_late_average(transfer: BandTransfer) -> BandTransfer:
    """The long-time average over the later half of the times, its error that of the block means and of not having settled."""
    average, unsettled = late_average(transfer.times, transfer.mean[None])
    blocks, _ = late_average(transfer.times, transfer.block_mean)
    weights = torch.tensor(transfer.block_counts, dtype=blocks.dtype)[:, None, None]
    squares = (weights * (blocks - average).square()).sum(0)
    error = torch.full_like(squares, torch.inf)
    if transfer.is_ordered:
        error = torch.zeros_like(squares)
    elif len(blocks) > 1:
        error = (squares / weights.sum() / (len(blocks) - 1)).sqrt()
    stderr = (error.square() + unsettled.square()).sqrt()
    return replace(transfer, long_time=average[0], long_time_stderr=stderr, block_long_time=blocks)


def _from_theory(scene: Scene, long_time: bool) -> BandTransfer:
    """The transfer of the scene's law of disorder, without chains; its realizations do not matter."""
    if scene.lattice is not None:
        return _from_lattice_theory(scene)
    if scene.species:
        raise checks.fail("species", "be left out for method 'theory'", [each.name for each in scene.species])
    if scene.energy_definition != "site":
        raise checks.fail("energy_definition", "be 'site' for method 'theory'", repr(scene.energy_definition))
    found = theory_transfer(
        scene.disorder, scene.n_particles, scene.n_bands, scene.times, scene.tones, scene.boundary,
        scene.stiffness_disorder, scene.contact, scene.damping,
    )  # fmt: skip
    return _of_law(scene, found.mean, found.long_time if long_time else None, found.systematic)


def _from_lattice_theory(scene: Scene) -> BandTransfer:
    """The same of scalar lattices, without a long-time average and an estimate of what the ladder misses."""
    for name, wanted in (("motion", "scalar"), ("boundary", "periodic"), ("damping", 0.0), ("removed_bonds", 0.0)):
        value = getattr(scene, name)
        if value != wanted:
            raise checks.fail(name, f"be {wanted!r} for method 'theory' of lattices", repr(value))
    if scene.stiffness_disorder is not None and scene.stiffness_disorder.strength > 0:
        raise checks.fail("stiffness_disorder", "be None for method 'theory' of lattices", scene.stiffness_disorder)
    assert scene.lattice is not None
    assert scene.shape is not None
    mean = lattice_transfer(scene.disorder, scene.lattice, scene.shape, scene.n_bands, scene.times, scene.tones)
    return _of_law(scene, mean, None, None)


def _of_law(scene: Scene, mean: Tensor, late: Tensor | None, systematic: Tensor | None) -> BandTransfer:
    """A transfer without statistical error."""
    law = law_of(scene.disorder)
    attributes = {
        "method": THEORY, "method_options": "{}", "mass_mean": law.mean, "mass_sd": max(0.0, law.variance) ** 0.5,
    }  # fmt: skip
    return BandTransfer(
        scene, scene.times, mean, torch.zeros_like(mean), late, None if late is None else torch.zeros_like(late),
        mean[None], None if late is None else late[None], (1,), attributes, Provenance("theory", describe(scene)),
        systematic,
    )  # fmt: skip


def _transfer_scene(scene: Scene) -> Scene:
    """The scene with its tones spelled out, checked for one tone in every band."""
    if not isinstance(scene.excitation, StandingWave):
        raise checks.fail("excitation", "be standing waves for a band transfer", type(scene.excitation).__name__)
    scene = replace(scene, observables=("band_energy",), excitation=replace(scene.excitation, tones=scene.tones))
    bands = scene.source_bands
    if bands != list(range(1, scene.n_bands + 1)):
        raise checks.fail(
            "excitation.tones", f"lie one in each of the {scene.n_bands} bands, in order", f"bands {bands}"
        )
    return scene
