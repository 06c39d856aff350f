"""Labels of results: coordinates, units and what a result says of its scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain._version import __version__
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import Moments


def ordered_error(scene: Scene, moment: Moments) -> Tensor:
    """Standard error of an ensemble: zero where every realization is the same chain."""
    return torch.zeros_like(moment.mean) if scene.is_ordered else moment.stderr


def coordinates(scene: Scene, axes: set[str]) -> dict[str, Any]:
    """Coordinates of the given axes, counted from 1, with units."""
    n = scene.n_particles
    k = {"units": "rad / particle distance", "long_name": "wavenumber |k|"}
    every = {
        "time": (
            "time",
            scene.times.numpy(),
            {"units": "travel time of sound over one particle", "long_name": "time t"},
        ),
        "particle": ("particle", np.arange(1, n + 1), {"long_name": "particle number p"}),
        "tone": ("tone", np.array(scene.tones, dtype=np.int64), {"long_name": "tone of the standing wave"}),
        "band": ("band", np.arange(1, scene.n_bands + 1), {"long_name": "wavenumber band r"}),
        "wavenumber": ("wavenumber", 2 * np.pi / n * np.arange(n // 2 + 1), k),
    }
    chosen = {name: every[name] for name in every if name in axes}
    if scene.si is not None and "time" in axes:
        chosen["time_si"] = ("time", scene.si.to_si("time", scene.times).numpy(), {"units": "s", "long_name": "time t"})
    if scene.si is not None and "particle" in axes:
        place = scene.si.spacing * np.arange(1, n + 1)
        chosen["place_si"] = ("particle", place, {"units": "m", "long_name": "rest position of the particle"})
    return chosen


def scene_attributes(scene: Scene) -> dict[str, Any]:
    """What every result says of its scene."""
    return {
        "scene": scene.to_toml(),
        "seed": str(scene.seed),
        "realizations": scene.realizations,
        "redrawn_fraction": scene.disorder.redrawn_fraction,
        "torchchain_version": __version__,
    }
