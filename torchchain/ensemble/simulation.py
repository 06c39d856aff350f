"""Ensemble means of the observables of a scene."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchchain.chain.excitation import Impulse
from torchchain.ensemble import plan as planning
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.labels import coordinates, ordered_error, scene_attributes
from torchchain.ensemble.observables import chosen_observables
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.run import ensemble_moments
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.statistics import Moments, merged
from torchchain.threads import single_thread

if TYPE_CHECKING:
    import xarray


class SeamWarning(UserWarning):
    """A center or width of energy on a ring that it has gone round: particle N lies beside particle 1.

    Example:
        >>> import warnings
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     ring = tc.Scene(n_particles=16, excitation=tc.Impulse(3), times=[9.0], realizations=2, observables=("width",))
        ...     _ = tc.simulate(ring, "modes")
        >>> [warning.category.__name__ for warning in told]
        ['SeamWarning']
    """


def simulate(
    scene: Scene,
    method: str = "auto",
    *,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
) -> xarray.Dataset:
    """Ensemble means of the scene's observables and their standard errors.

    Args:
        scene: what is wanted; its ``observables`` name the variables.
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        device, memory_budget, progress, stages, options: see :func:`stream`.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.
        ranks: processes that share the realizations, from :func:`torchchain.ensemble.ranks.process_group`; each gets the result.

    Returns:
        Dataset with a variable and its ``_stderr`` for every observable, axes ([tone,] time, particle | wavenumber |
        band), coordinates counted from 1, units in the attributes; realized mass moments in the attributes.
        A single realization of a disordered chain has the standard error infinity.

    Warns:
        SeamWarning: for the center or width of a kick's energy on a ring, once it reaches particle 1 or N.

    Example:
        >>> scene = tc.Scene(n_particles=64, boundary="fixed", excitation=tc.Impulse(site=1), times=[0.0, 10.0, 20.0],
        ...                  observables=("center", "width"), realizations=10)
        >>> result = tc.simulate(scene, method="modes")
        >>> sorted(result.data_vars)
        ['center', 'center_stderr', 'width', 'width_stderr']
        >>> result.center.attrs["units"]
        'particle'
    """
    scene = planning.resolved(scene)
    if not ranks.rank:
        _warn_at_seam(scene)
    ensemble = ensemble_moments(
        scene, method, device=device, memory_budget=memory_budget, progress=progress, stages=stages, options=options,
        checkpoint=checkpoint, ranks=ranks,
    )  # fmt: skip
    with single_thread():
        found = {name: merged(ensemble.moments.blocks(name)) for name in scene.observables}
        return _dataset(scene, found, ensemble.attributes)


def _warn_at_seam(scene: Scene) -> None:
    """A :class:`SeamWarning` where a kick's energy, at the speed of sound, reaches the ends of a ring within the times."""
    names = [entry.name for entry in chosen_observables(scene.observables) if entry.on_a_line]
    away = min(scene.site - 1, scene.n_particles - scene.site)
    if names and scene.boundary == "periodic" and isinstance(scene.excitation, Impulse) and float(scene.times[-1]) > away:
        warnings.warn(
            f"{' and '.join(names)} count{'s' * (len(names) == 1)} the particles of a ring from 1 to {scene.n_particles}, though "
            f"these two are neighbors: the energy of a kick at {scene.site} passes between them from time {away} on (boundary 'fixed', "
            "a site farther from both or earlier times keep it away)",
            SeamWarning,
            stacklevel=3,
        )


def _dataset(scene: Scene, moments: dict[str, Moments], attributes: dict[str, Any]) -> xarray.Dataset:
    import xarray

    leading = ("tone",) if scene.tones else ()
    variables: dict[str, Any] = {}
    used: set[str] = set()
    for entry in chosen_observables(scene.observables):
        moment, axes = moments[entry.name], leading + entry.axes
        used.update(axes)
        label = {"units": entry.unit, "long_name": entry.label}
        error = {"units": entry.unit, "long_name": f"standard error of {entry.label}"}
        variables[entry.name] = (axes, moment.mean.numpy(), label)
        variables[f"{entry.name}_stderr"] = (axes, ordered_error(scene.is_ordered, moment).numpy(), error)
    return xarray.Dataset(variables, coords=coordinates(scene, used), attrs=scene_attributes(scene) | attributes)
