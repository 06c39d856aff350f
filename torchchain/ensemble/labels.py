"""Labels of results: coordinates, units and what a result says of its scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain._version import __version__
from torchchain.chain.scaling import Scaling
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import Moments
from torchchain.network.random_lattices import RandomLattices

if TYPE_CHECKING:
    import xarray


def tensor_of(data: xarray.Dataset, name: str) -> Tensor:
    """A variable of float32 or float64, as it is.

    Raises:
        FieldError, FieldTypeError: for one that is missing or of another kind.
    """
    if name not in data:
        raise checks.fail("data", f"hold the variable {name}", ", ".join(map(str, data)))
    values = np.array(data[name].values)
    if values.dtype not in (np.float32, np.float64):
        raise checks.FieldTypeError(f"data.{name} must be of float32 or float64, got {values.dtype}")
    return torch.from_numpy(values)


def ordered_error(is_ordered: bool, moment: Moments) -> Tensor:
    """Standard error of an ensemble: zero where every realization is the same chain."""
    return torch.zeros_like(moment.mean) if is_ordered else moment.stderr


def time_coordinates(times: Tensor, si: Scaling | None = None) -> dict[str, Any]:
    """The axis of output times, in seconds too where the scale is known."""
    units = {"units": "travel time of sound over one particle", "long_name": "time t"}
    found = {"time": ("time", times.numpy(), units)}
    if si is not None:
        found["time_si"] = ("time", si.to_si("time", times).numpy(), {"units": "s", "long_name": "time t"})
    return found


def coordinates(scene: Scene, axes: set[str]) -> dict[str, Any]:
    """Coordinates of the given axes, counted from 1, with units."""
    n = scene.n_particles
    k = {"units": "rad / particle distance", "long_name": "wavenumber |k|"}
    tone, band = "tone of the standing wave", "wavenumber band r"
    if scene.lattice is not None:
        tone, band = "band of the plane wave", "band r: shell of |q| and polarization"
    elif scene.by_species:
        tone, band = "band whose wave starts", "band r: species and |k|"
    every = {
        "particle": ("particle", np.arange(1, n + 1), {"long_name": "particle number p"}),
        "tone": ("tone", np.array(scene.tones, dtype=np.int64), {"long_name": tone}),
        "band": ("band", np.arange(1, scene.n_bands + 1), {"long_name": band}),
        "wavenumber": ("wavenumber", 2 * np.pi / n * np.arange(n // 2 + 1), k),
    }
    if scene.species:
        every |= _of_mixtures(scene)
    if scene.lattices is not None:
        every |= _of_lattices(scene, scene.lattices)
    chosen = time_coordinates(scene.times, scene.si) if "time" in axes else {}
    chosen |= {name: values for name, values in every.items() if values[0] in axes}
    if scene.si is not None and "particle" in axes:
        place = scene.si.spacing * np.arange(1, n + 1)
        chosen["place_si"] = ("particle", place, {"units": "m", "long_name": "rest position of the particle"})
    return chosen


def _of_lattices(scene: Scene, lattices: RandomLattices) -> dict[str, Any]:
    """Coordinates that lattices have besides those of chains."""
    distance = {"units": "particle distance"}
    found: dict[str, Any] = {
        "ring": ("ring", np.arange(scene.lengths["ring"]), {**distance, "long_name": "distance from the source"}),
    }
    for axis, place in zip("xyz", lattices.ordered.positions.numpy().T, strict=False):
        found[axis] = ("particle", place, {**distance, "long_name": f"rest position {axis}"})
    if scene.needs_bands:
        bands = lattices.bands(scene.n_bands)
        middle = (bands.edges[1:] + bands.edges[:-1]).numpy() / 2
        found["polarization"] = ("band", np.repeat(bands.polarizations, bands.n_shells), {"long_name": "polarization"})
        k = {"units": "rad / particle distance", "long_name": "|q| in the middle of the shell"}
        found["shell"] = ("band", np.tile(middle, len(bands.polarizations)), k)
    return found


def _of_mixtures(scene: Scene) -> dict[str, Any]:
    """Coordinates that mixtures have besides those of chains."""
    names = np.array([each.name for each in scene.species])
    found: dict[str, Any] = {"species": ("species", names, {"long_name": "species of the beads"})}
    if not scene.by_species:
        return found
    each = scene.bands_each
    middle = np.pi / each * (np.arange(each) + 0.5)
    k = {"units": "rad / particle distance", "long_name": "|k| in the middle of the band"}
    return found | {
        "band_species": ("band", names.repeat(each), {"long_name": "species"}),
        "band_wavenumber": ("band", np.tile(middle, len(names)), k),
    }


def scene_attributes(scene: Scene) -> dict[str, Any]:
    """What every result says of its scene."""
    return {
        "scene": scene.to_toml(),
        "seed": str(scene.seed),
        "realizations": scene.realizations,
        "redrawn_fraction": scene.disorder.redrawn_fraction,
        "torchchain_version": __version__,
    }
