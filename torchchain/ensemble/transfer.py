"""The transfer of energy between wavenumber bands, averaged over an ensemble."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray
from torch import Tensor

from torchchain import checks
from torchchain.chain.excitation import StandingWave
from torchchain.energy.bands import band_of
from torchchain.ensemble import plan as planning
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.chunk import Chunk
from torchchain.ensemble.labels import coordinates, ordered_error, scene_attributes
from torchchain.ensemble.layout import BLOCKS
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.run import Ensemble, ensemble_moments
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.statistics import merged
from torchchain.threads import single_thread


@dataclass(frozen=True, eq=False)
class BandTransfer:
    """Band energies of an ensemble in which each band in turn is the source of a unit energy.

    Attributes:
        scene: the ensemble; its tones hold one tone of every band, in order.
        times: (time,).
        mean, stderr: share of the energy, [source, time, receiver].
        long_time, long_time_stderr: infinite-time average, [source, receiver]; None if not asked for.
        block_mean: means over consecutive blocks of realizations, [block, source, time, receiver].
        block_long_time: [block, source, receiver], or None.
        block_counts: realizations (of opposite ones, pairs) in each block.
        attributes: realized mean and standard deviation of the masses, ``mass_mean`` and ``mass_sd``; the ``method`` that
            evolved the chains and, as JSON, its ``method_options``.
    """

    scene: Scene
    times: Tensor
    mean: Tensor
    stderr: Tensor
    long_time: Tensor | None
    long_time_stderr: Tensor | None
    block_mean: Tensor
    block_long_time: Tensor | None
    block_counts: tuple[int, ...]
    attributes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks.instance("scene", self.scene, Scene)
        checks.instance("attributes", self.attributes, dict)
        object.__setattr__(self, "times", checks.times("times", self.times))
        counts, n = self.block_counts, self.scene.n_bands
        if not isinstance(counts, (list, tuple)) or not counts:
            raise checks.FieldTypeError(f"block_counts must be a list of integers, got {checks.shown(counts)}")
        object.__setattr__(self, "block_counts", tuple(checks.integer("block_counts", c, 1) for c in counts))
        whole, late, blocks = (n, len(self.times), n), (n, n), len(counts)
        shapes = {
            "mean": whole, "stderr": whole, "long_time": late, "long_time_stderr": late,
            "block_mean": (blocks, *whole), "block_long_time": (blocks, *late),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None and "long_time" in name and self.long_time is None:
                continue
            checks.instance(name, value, Tensor)
            if value.layout != torch.strided or value.is_meta or not value.is_floating_point():
                raise checks.FieldTypeError(f"{name} must be a dense floating-point tensor, got {value.dtype}")
            if tuple(value.shape) != shape:
                raise checks.fail(name, f"have shape {shape}", f"shape {tuple(value.shape)}")
            if "stderr" in name:  # infinite for one realization
                checks.first_bad(name, "not be negative", value, ~(value >= 0), "band")
            else:
                checks.real_tensor(name, value)

    @property
    def n_bands(self) -> int:
        return self.mean.shape[-1]

    @property
    def damping(self) -> float:
        """Contact damping; 0 for data from elsewhere, whose shares of the energy are of that at each time."""
        return 0.0 if self.scene is None else self.scene.damping

    @property
    def is_ordered(self) -> bool:
        """Whether every realization is the same chain, so that there is no error of an ensemble."""
        return self.scene is not None and self.scene.is_ordered

    def to_dataset(self) -> xarray.Dataset:
        """Labeled axes and units, for netCDF; :meth:`from_dataset` reads it back."""
        s, t, r, b = "source", "time", "receiver", "block"
        share = {"units": "1", "long_name": "share of the energy in the receiving band"}
        variables: dict[str, Any] = {
            "band_energy": ((s, t, r), self.mean.numpy(), share),
            "band_energy_stderr": ((s, t, r), self.stderr.numpy(), {"units": "1", "long_name": "its standard error"}),
            "block_band_energy": ((b, s, t, r), self.block_mean.numpy(), {"units": "1", "long_name": "block means"}),
            "block_count": ((b,), np.array(self.block_counts), {"units": "1", "long_name": "realizations in a block"}),
        }
        if self.long_time is not None and self.long_time_stderr is not None and self.block_long_time is not None:
            variables["long_time"] = (
                (s, r), self.long_time.numpy(), {"units": "1", "long_name": "infinite-time average of the share"},
            )  # fmt: skip
            variables["long_time_stderr"] = ((s, r), self.long_time_stderr.numpy(), {"units": "1"})
            variables["block_long_time"] = ((b, s, r), self.block_long_time.numpy(), {"units": "1"})
        bands = np.arange(1, self.n_bands + 1)
        coords = {
            **coordinates(self.scene, {"time"}),
            s: (s, bands, {"long_name": "band s of the initial standing wave"}),
            r: (r, bands, {"long_name": "receiving band r"}),
        }
        return xarray.Dataset(variables, coords=coords, attrs=scene_attributes(self.scene) | self.attributes)

    @classmethod
    def from_dataset(cls, data: xarray.Dataset) -> BandTransfer:
        """The inverse of :meth:`to_dataset`.

        Raises:
            FieldError, FieldTypeError: for a dataset that is not of a band transfer.
        """
        checks.instance("data", data, xarray.Dataset)
        needed = ("band_energy", "band_energy_stderr", "block_band_energy", "block_count")
        late = ("long_time", "long_time_stderr", "block_long_time") if "long_time" in data else ()
        for name in (*needed, *late):
            if name not in data:
                raise checks.fail(
                    "data", f"hold the variable {name} of a band transfer", f"{', '.join(map(str, data))}"
                )
        for name in ("scene", "mass_mean", "mass_sd"):
            if name not in data.attrs:
                raise checks.fail("data", f"have the attribute {name} of a band transfer", "none")
        try:
            scene = Scene.from_dict(tomllib.loads(str(data.attrs["scene"])))
        except (ValueError, RecursionError) as error:
            raise checks.fail("data", "have the attribute scene of a band transfer", str(error)) from None
        if "time" in data.coords and not np.array_equal(data["time"].values, scene.times.numpy()):
            raise checks.fail("data", "have the times of its scene", checks.shown(data["time"].values))

        def tensor(name: str) -> Tensor:
            values = np.array(data[name].values)
            if values.dtype not in (np.float32, np.float64):
                raise checks.FieldTypeError(f"data.{name} must be of float32 or float64, got {values.dtype}")
            return torch.from_numpy(values)

        held = "long_time" in data
        return cls(
            scene,
            scene.times,
            tensor("band_energy"),
            tensor("band_energy_stderr"),
            tensor("long_time") if held else None,
            tensor("long_time_stderr") if held else None,
            tensor("block_band_energy"),
            tensor("block_long_time") if held else None,
            tuple(checks.integer("data.block_count", n, 1) for n in np.atleast_1d(data["block_count"].values)),
            {name: checks.number(f"data.{name}", data.attrs[name]) for name in ("mass_mean", "mass_sd")}
            | {name: str(data.attrs[name]) for name in ("method", "method_options") if name in data.attrs},
        )


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
) -> BandTransfer:
    """The transfer of energy from every band to every band: one standing wave per band, averaged over the ensemble.

    Args:
        scene: standing waves with one tone in each of its bands, or none given (the bands' center tones).
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        long_time: also take the exact infinite-time average from the modes; damped chains have none.
        device, memory_budget, progress, stages, options: see :func:`stream`.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.
        ranks: processes that share the realizations, from :func:`torchchain.ranks.process_group`; each gets the result.

    Returns:
        BandTransfer with mean and stderr [source, time, receiver].

    Raises:
        FieldError: if the excitation is no standing wave, or a band has not exactly one tone.
    """
    checks.truth("long_time", long_time)
    scene, stages = _transfer_scene(planning.resolved(scene)), stages or Stages()
    long_time = long_time and scene.damping == 0
    n_blocks = min(BLOCKS, scene.distinct_realizations // scene.sample_size)

    def measure(chunk: Chunk) -> dict[str, Tensor]:
        measured = chunk.observe(["band_energy"])
        return measured | ({"long_time": chunk.long_time()} if long_time else {})

    ensemble = ensemble_moments(
        scene, measure, method, n_blocks, names=("band_energy", *["long_time_band_energy"] * long_time), device=device,
        memory_budget=memory_budget, progress=progress, stages=stages, options=options, checkpoint=checkpoint,
        ranks=ranks,
    )  # fmt: skip
    with single_thread(), stages("statistics"):
        return _transfer(scene, ensemble, long_time)


def _transfer(scene: Scene, ensemble: Ensemble, long_time: bool) -> BandTransfer:
    """The BandTransfer of the blocks' moments in time and at infinite time."""
    moments = ensemble.moments
    blocks = moments.blocks("band_energy")
    total = merged(blocks)
    ends = moments.blocks("long_time") if long_time else []
    average_at_end = merged(ends) if ends else None
    return BandTransfer(
        scene,
        scene.times,
        total.mean,
        ordered_error(scene, total),
        average_at_end.mean if average_at_end else None,
        ordered_error(scene, average_at_end) if average_at_end else None,
        torch.stack([block.mean for block in blocks]),
        torch.stack([block.mean for block in ends]) if ends else None,
        tuple(block.count for block in blocks),
        ensemble.attributes,
    )


def _transfer_scene(scene: Scene) -> Scene:
    """The scene with its tones spelled out, checked for one tone in every band."""
    if not isinstance(scene.excitation, StandingWave):
        raise checks.fail("excitation", "be standing waves for a band transfer", type(scene.excitation).__name__)
    scene = replace(scene, observables=("band_energy",), excitation=replace(scene.excitation, tones=scene.tones))
    bands = [band_of(tone, scene.n_particles, scene.n_bands) for tone in scene.tones]
    if bands != list(range(1, scene.n_bands + 1)):
        raise checks.fail(
            "excitation.tones", f"lie one in each of the {scene.n_bands} bands, in order", f"bands {bands}"
        )
    return scene
