"""Transfer from other starts than the calibrated tones at rest: other tones of each band, and kicks.

One more run, of all realizations at few times: the center and the last tone of every band, released at rest; what a
kick of the same shape would do follows from the same motion (:mod:`torchchain.energy.kicked`). Everything is rounded well
below its noise, so that a file of it is small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.ensemble.block_means import QUIET
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.labels import ordered_error, tensor_of, time_coordinates
from torchchain.ensemble.run import ensemble_moments
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import merged

if TYPE_CHECKING:
    import xarray

FEWEST = 16
"""Independent samples of a scene from which on other starts are measured."""
TIMES = 24
"""At most so many times above 0, evenly in their logarithm."""
FIRST = 0.5
"""The first of them, where the scene's times are not earlier."""
FINENESS = 4.0
"""Standard errors to the unit to which means are rounded, at least."""
ERROR_BITS = 4
"""Significant bits of a standard error."""
NAMES = ("released", "released_stderr", "kicked", "kicked_stderr")
KINDS = NAMES[::2]


@dataclass(frozen=True, eq=False)
class StartTransfer:
    """Share of the energy in each band after starts from single tones, averaged over an ensemble.

    Attributes:
        tones: counted from 1, increasing.
        times: (time,).
        released, released_stderr: standing waves at rest, [tone, time, receiver].
        kicked, kicked_stderr: standing waves of velocity in an undeformed chain, [tone, time, receiver].
        samples: independent ones.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=torch.linspace(0, 50, 51))
        >>> starts = tc.band_transfer(scene).starts
        >>> starts.tones[:4], tuple(starts.kicked.shape)
        ((2, 4, 6, 8), (16, 25, 8))
    """

    tones: tuple[int, ...]
    times: Tensor
    released: Tensor
    released_stderr: Tensor
    kicked: Tensor
    kicked_stderr: Tensor
    samples: int

    def __post_init__(self) -> None:
        tones = tuple(checks.integer("starts.tones", tone, 1) for tone in self.tones)
        if not tones or any(b <= a for a, b in pairwise(tones)):
            raise checks.fail("starts.tones", "increase", tones)
        object.__setattr__(self, "tones", tones)
        object.__setattr__(self, "samples", checks.integer("starts.samples", self.samples, 1))
        object.__setattr__(self, "times", checks.times("starts.times", self.times))
        for name in NAMES:
            value = checks.real_tensor(f"starts.{name}", getattr(self, name))
            if value.ndim != 3 or tuple(value.shape[:2]) != (len(tones), len(self.times)):
                rule = f"have the axes [tone, time, receiver] of {len(tones)} tones and {len(self.times)} times"
                raise checks.fail(f"starts.{name}", rule, value)
            if value.shape != self.released.shape:
                raise checks.fail(f"starts.{name}", f"have shape {tuple(self.released.shape)}", value)
            if name.endswith("stderr"):
                checks.first_bad(f"starts.{name}", "not be negative", value, value < 0, "band")

    def variables(self) -> dict[str, Any]:
        """Labeled variables of a dataset, their coordinates among them; :meth:`from_dataset` reads them back."""
        axes = ("start_tone", "start_time", "receiver")
        packed = {"zlib": True, "complevel": 5, "shuffle": True}
        found: dict[str, Any] = {
            "start_tone": ("start_tone", np.array(self.tones), {"long_name": "tone of the start"}),
            "start_time": ("start_time", *time_coordinates(self.times)["time"][1:]),
            "start_samples": ((), self.samples, {"units": "1", "long_name": "independent samples"}),
        }  # fmt: skip
        for kind, words in zip(KINDS, ("a wave released at rest", "a wave of velocity"), strict=True):
            for name, label in ((kind, f"share of the energy in the receiving band after {words}"), (f"{kind}_stderr", "its standard error")):  # fmt: skip
                values = getattr(self, name).numpy().astype(np.float32)
                found[name] = (axes, values, {"units": "1", "long_name": label}, packed)
        return found

    @classmethod
    def from_dataset(cls, data: xarray.Dataset) -> StartTransfer | None:
        """The inverse of :meth:`variables`; None where there are none."""
        if "start_tone" not in data:
            return None

        tones = tuple(checks.integer("data.start_tone", tone, 1) for tone in np.atleast_1d(data["start_tone"].values))
        samples = checks.integer(
            "data.start_samples", data["start_samples"].values.tolist() if "start_samples" in data else 0, 1
        )
        times, *found = (tensor_of(data, name).double() for name in ("start_time", *NAMES))
        return cls(tones, times, samples=samples, **dict(zip(NAMES, found, strict=True)))


def start_tones(scene: Scene) -> tuple[int, ...]:
    """The center and the last tone of every band, in order."""
    width = scene.n_particles // 2 // scene.n_bands
    return tuple(sorted({*scene.tones, *(width * band for band in range(1, scene.n_bands + 1))}))


def start_times(times: Tensor) -> Tensor:
    """Time 0 and at most :data:`TIMES` later ones up to the last of the scene."""
    later = times[times > 0]
    if not len(later):
        return times[:1]
    first, last = min(FIRST, float(later[0])), float(later[-1])
    found = (
        torch.logspace(math.log10(first), math.log10(last), TIMES, dtype=times.dtype) if last > first else later[-1:]
    )
    found[-1] = last  # not a rounding beyond
    return torch.cat([times.new_zeros(1), found])


def measurable(scene: Scene) -> bool:
    """Whether other starts of a scene are measured: of undamped, linear rings, in which the energy is quadratic, of enough samples."""
    needed = {"lattice": None, "species": (), "contact": "linear", "damping": 0, "boundary": "periodic"}
    needed["energy_definition"] = "site"  # by bonds a kick has spread over wavenumbers at once
    linear = all(getattr(scene, name) == value for name, value in needed.items())
    return linear and scene.distinct_realizations // scene.sample_size >= FEWEST


def start_scene(scene: Scene) -> Scene:
    """The ensemble of the other starts of a scene with standing waves."""
    assert isinstance(scene.excitation, StandingWave), "transfers come from standing waves"
    return replace(
        scene, realizations=scene.distinct_realizations, times=start_times(scene.times),
        observables=("band_energy", "kicked_band_energy"),
        excitation=replace(scene.excitation, tones=start_tones(scene), phase="cos"),  # the sine of tone N/2 is none
    )  # fmt: skip


def start_transfer(
    scene: Scene, method: str, options: dict[str, Any], checkpoint: Checkpoint | None, **settings: Any
) -> StartTransfer:
    """Measure the other starts of a scene with standing waves.

    Args:
        scene: measurable, with one tone in each band.
        method, options: that evolve its chains.
        checkpoint: of this run alone.
        settings: the rest of :func:`torchchain.ensemble.run.ensemble_moments`.
    """
    other = start_scene(scene)
    moments = ensemble_moments(other, method, 1, options=options, checkpoint=checkpoint, **settings).moments
    found: dict[str, Tensor] = {}
    for kind, name in zip(KINDS, other.observables, strict=True):
        total = merged(moments.blocks(name))
        found[kind], found[f"{kind}_stderr"] = _rounded(total.mean, ordered_error(scene.is_ordered, total))
    return StartTransfer(start_tones(scene), other.times, samples=other.realizations // scene.sample_size, **found)


def _rounded(mean: Tensor, stderr: Tensor) -> tuple[Tensor, Tensor]:
    """Mean to a power of two at most a quarter of its standard error, and that to a few bits: numbers of single precision."""
    noisy = stderr.isfinite() & (stderr > QUIET)
    mantissa, exponent = torch.frexp(stderr)
    error = torch.ldexp((mantissa * 2.0**ERROR_BITS).round() / 2.0**ERROR_BITS, exponent)
    unit = torch.ldexp(torch.ones_like(stderr), torch.frexp(stderr / FINENESS)[1] - 1)
    mean = torch.where(noisy, (mean / unit).round() * unit, mean)
    return mean.float().double(), torch.where(noisy, error, stderr).float().double()
