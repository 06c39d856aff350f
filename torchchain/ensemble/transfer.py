"""The transfer of energy between wavenumber bands, averaged over an ensemble: simulated, or from data of any origin."""

from __future__ import annotations

import hashlib
import json
import os
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import xarray
from torch import Tensor

from torchchain import checks, plots
from torchchain._version import __version__
from torchchain.chain.chain import Chain
from torchchain.chain.excitation import StandingWave
from torchchain.chain.states import Trajectory
from torchchain.ensemble import plan as planning
from torchchain.ensemble.block_means import decoded, encoded, rounded
from torchchain.ensemble.checkpoint import Checkpoint
from torchchain.ensemble.imported import as_shares, gathered
from torchchain.ensemble.labels import ordered_error, scene_attributes, time_coordinates
from torchchain.ensemble.layout import BLOCKS
from torchchain.ensemble.mixed_starts import fit_transfer, unmixed
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.run import ensemble_moments
from torchchain.ensemble.scene import Scene, describe
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.starts import StartTransfer, measurable, start_transfer
from torchchain.ensemble.statistics import EnsembleMoments, Moments, merged
from torchchain.network import Network
from torchchain.theory.lattices import lattice_transfer
from torchchain.theory.law import law_of
from torchchain.theory.transfer import theory_transfer
from torchchain.threads import single_thread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

THEORY = "theory"
"""The method of a transfer without chains."""
MOST_UNKNOWNS = 1500
"""Of lattices whose long-time average is taken from all modes; beyond it from the later half of the times."""
OF_RUNS = ("mass_mean", "mass_sd", "start_condition")
"""Attributes of a transfer from runs of another code."""


@dataclass(frozen=True)
class Provenance:
    """Where a band transfer comes from.

    Attributes:
        kind: "simulated" from a scene, or "imported".
        words: for people.
        hashes: SHA-256 by name of what it was made from.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=16, n_bands=2, realizations=2, times=[0.0]), method="modes")
        >>> transfer.provenance.kind
        'simulated'
    """

    kind: str = "imported"
    words: str = ""
    hashes: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks.instance("provenance.kind", self.kind, str)
        checks.instance("provenance.words", self.words, str)
        checks.instance("provenance.hashes", self.hashes, dict)


@dataclass(frozen=True, eq=False, repr=False)
class BandTransfer(Printed):
    """Band energies of an ensemble in which each band in turn is the source of a unit energy.

    Attributes:
        scene: the ensemble, its tones one of every band, in order; None for data from elsewhere.
        times: (time,).
        mean, stderr: share of the energy, [source, time, receiver].
        long_time, long_time_stderr: infinite-time average, [source, receiver]; None if not known.
        block_mean: means over consecutive blocks of realizations, [block, source, time, receiver]. Of large transfers (a
            million numbers and more) they and ``stderr`` are rounded to what their noise tells, well below it, with all
            sums kept (see :mod:`torchchain.ensemble.block_means`); the mean is exact.
        block_long_time: [block, source, receiver], or None.
        block_counts: realizations (of opposite ones, pairs) in each block.
        attributes: of a simulation the realized mean and standard deviation of the masses, ``mass_mean`` and
            ``mass_sd``, the ``method`` that evolved the chains and, as JSON, its ``method_options``; of imported runs the
            moments of the masses where they are known, and ``start_condition``, the condition number of the least squares
            over their starts (1: each run starts in one band).
        provenance: where it comes from; of a simulation, left out, its scene.
        systematic: of a transfer from theory, estimated total variation distance from an endless ensemble, [source, time];
            else None.
        starts: the transfer from other tones of each band and from kicks; None where it was not measured.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=20, times=[0.0, 5.0, 50.0])
        >>> transfer = tc.band_transfer(scene, method="modes")
        >>> tuple(transfer.mean.shape), tuple(transfer.long_time.shape)
        ((8, 3, 8), (8, 8))
        >>> torch.allclose(transfer.mean.sum(-1), torch.ones(8, 3, dtype=torch.float64), atol=1e-2)  # the rest is k = 0
        True
    """

    scene: Scene | None
    times: Tensor
    mean: Tensor
    stderr: Tensor
    long_time: Tensor | None
    long_time_stderr: Tensor | None
    block_mean: Tensor
    block_long_time: Tensor | None
    block_counts: tuple[int, ...]
    attributes: dict[str, Any] = field(default_factory=dict)
    provenance: Provenance | None = None
    systematic: Tensor | None = None
    starts: StartTransfer | None = None

    def __post_init__(self) -> None:
        checks.instance("scene", self.scene, Scene, type(None))
        checks.instance("attributes", self.attributes, dict)
        checks.instance("provenance", self.provenance, Provenance, type(None))
        checks.instance("starts", self.starts, StartTransfer, type(None))
        if self.provenance is None:
            origin = Provenance()
            if self.scene is not None:
                scene_hash = hashlib.sha256(self.scene.to_toml().encode()).hexdigest()
                origin = Provenance("simulated", describe(self.scene), {"scene": scene_hash})
            object.__setattr__(self, "provenance", origin)
        object.__setattr__(self, "times", checks.times("times", self.times))
        checks.instance("mean", self.mean, Tensor)
        if self.mean.ndim != 3:
            raise checks.fail("mean", "have the axes [source, time, receiver]", f"shape {tuple(self.mean.shape)}")
        counts, n = self.block_counts, self.scene.n_bands if self.scene is not None else len(self.mean)
        if not isinstance(counts, (list, tuple)) or not counts:
            raise checks.FieldTypeError(f"block_counts must be a list of integers, got {checks.shown(counts)}")
        object.__setattr__(self, "block_counts", tuple(checks.integer("block_counts", c, 1) for c in counts))
        whole, late, blocks = (n, len(self.times), n), (n, n), len(counts)
        shapes = {
            "mean": whole, "stderr": whole, "long_time": late, "long_time_stderr": late,
            "block_mean": (blocks, *whole), "block_long_time": (blocks, *late), "systematic": whole[:2],
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None and (name == "systematic" or ("long_time" in name and self.long_time is None)):
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
        if self.starts is not None and self.starts.released.shape[-1] != n:
            raise checks.fail("starts", f"have {n} receivers", self.starts.released.shape[-1])

    @property
    def n_bands(self) -> int:
        return self.mean.shape[-1]

    @property
    def damping(self) -> float:
        """Contact damping; 0 for data from elsewhere, whose shares of the energy are of that at each time."""
        return 0.0 if self.scene is None else self.scene.largest_damping

    @property
    def is_ordered(self) -> bool:
        """Whether no energy leaves its band: every realization is the same chain of equal masses."""
        if self.scene is not None:
            return self.scene.is_ordered
        still = torch.eye(self.n_bands, dtype=self.mean.dtype)[:, None]
        return float(self.times[-1]) > 0 and bool((self.mean == still).all())

    def _rows(self) -> dict[str, str]:
        assert self.provenance is not None
        known = "not known"
        if self.long_time is not None and self.long_time_stderr is not None:
            known = f"standard error up to {self.long_time_stderr.max():.1e}"
        method = {"evolved by": str(self.attributes["method"])} if "method" in self.attributes else {}
        return {
            "origin": " ".join(filter(None, (f"{self.provenance.kind}:", self.provenance.words or "not told"))),
            "axes": f"source {self.n_bands}, time {len(self.times)}, receiver {self.n_bands}",
            "times": f"{self.times[0]:g} to {self.times[-1]:g}",
            "samples": f"{sum(self.block_counts)} in {len(self.block_counts)} blocks",
            "mean": f"standard error up to {self.stderr.max():.1e}",
            "long_time": known,
            **({"starts": f"{len(self.starts.tones)} tones released and kicked, {self.starts.samples} samples"} if self.starts else {}),
            **method,
        }

    def plot(
        self, source: int, receivers: Sequence[int] | None = None, log: bool = True, ax: Axes | None = None
    ) -> Axes:
        """The share of a source's energy in some bands over time (as Fig. 14), with a band of one standard error.

        Args:
            source: band, counted from 1.
            receivers: bands, counted from 1; the source and its neighbors if left out.
            log: logarithmic shares.
            ax: where to draw; None for a figure of its own, a column wide.

        Returns:
            The axes; ``ax.figure.savefig(...)`` writes them.

        Raises:
            FieldError: for a band that is none of 1 to ``n_bands``.
        """
        source = checks.integer("source", source, 1, self.n_bands)
        near = range(max(1, source - 1), min(self.n_bands, source + 1) + 1) if receivers is None else receivers
        bands = [checks.integer("receivers", receiver, 1, self.n_bands) for receiver in near]
        mean, stderr = self.mean[source - 1].numpy(), self.stderr[source - 1].numpy()
        ax = plots.own_axes() if ax is None else ax
        return plots.decays(ax, self.times.numpy(), mean, stderr, source, bands, log=log)

    def plot_map(self, source: int | None = None, ax: Axes | None = None) -> Axes:
        """Shares of the energy as colors: of one source over time and band (Fig. 12), or of all pairs of bands in the end.

        Args:
            source: band, counted from 1; None for all sources at infinite time, or, where that is not known, the last time.
            ax: where to draw; None for a figure of its own, a column wide.

        Raises:
            FieldError: for a band that is none of 1 to ``n_bands``.
        """
        ax = plots.own_axes() if ax is None else ax
        if source is not None:
            mean = self.mean[checks.integer("source", source, 1, self.n_bands) - 1]
            return plots.band_map(ax, self.times.numpy(), mean.numpy(), f"source {source}")
        if self.long_time is not None:
            return plots.share_matrix(ax, self.long_time.numpy(), "infinite time")
        return plots.share_matrix(ax, self.mean[:, -1].numpy(), f"$t$ = {float(self.times[-1]):g}")

    def to_dataset(self) -> xarray.Dataset:
        """Labeled axes and units, for netCDF; :meth:`from_dataset` reads it back."""
        s, t, r, b = "source", "time", "receiver", "block"
        variables: dict[str, Any] = {}

        def put(name: str, axes: tuple[str, ...], values: Tensor, label: str) -> None:
            variables[name] = (axes, values.numpy(), {"units": "1", "long_name": label})

        put("band_energy", (s, t, r), self.mean, "share of the energy in the receiving band")
        put("band_energy_stderr", (s, t, r), self.stderr, "its standard error")
        whole = encoded(self.block_mean, self.mean, self.stderr, self.block_counts)
        if whole is None:
            put("block_band_energy", (b, s, t, r), self.block_mean, "block means")
        else:
            label = {"units": "1", "long_name": "block means as integers, which BandTransfer.load understands"}
            variables["block_steps"] = ((b, s, t, r), whole, label, {"zlib": True, "complevel": 4})
        put("block_count", (b,), torch.tensor(self.block_counts), "realizations in a block")
        if self.long_time is not None and self.long_time_stderr is not None and self.block_long_time is not None:
            put("long_time", (s, r), self.long_time, "infinite-time average of the share")
            put("long_time_stderr", (s, r), self.long_time_stderr, "its standard error")
            put("block_long_time", (b, s, r), self.block_long_time, "block means")
        if self.systematic is not None:
            put("systematic", (s, t), self.systematic, "estimated total variation distance from an endless ensemble")
        if self.starts is not None:
            variables |= self.starts.variables()
        bands = np.arange(1, self.n_bands + 1)
        coords = {
            **time_coordinates(self.times, self.scene.si if self.scene is not None else None),
            s: (s, bands, {"long_name": "band s of the initial standing wave"}),
            r: (r, bands, {"long_name": "receiving band r"}),
        }
        assert self.provenance is not None
        origin = {
            "provenance_kind": self.provenance.kind,
            "provenance": self.provenance.words,
            "provenance_hashes": json.dumps(self.provenance.hashes),
        }
        of_scene = {"torchchain_version": __version__} if self.scene is None else scene_attributes(self.scene)
        return xarray.Dataset(variables, coords=coords, attrs=of_scene | self.attributes | origin)

    @classmethod
    def from_dataset(cls, data: xarray.Dataset) -> BandTransfer:
        """The inverse of :meth:`to_dataset`.

        Raises:
            FieldError, FieldTypeError: for a dataset that is not of a band transfer.
        """
        checks.instance("data", data, xarray.Dataset)
        whole = "block_steps" in data
        needed = ("band_energy", "band_energy_stderr", "block_steps" if whole else "block_band_energy", "block_count")
        late = ("long_time", "long_time_stderr", "block_long_time") if "long_time" in data else ()
        for name in (*needed, *late):
            if name not in data:
                raise checks.fail(
                    "data", f"hold the variable {name} of a band transfer", f"{', '.join(map(str, data))}"
                )
        attributes = {name: data.attrs[name] for name in ("method", "method_options", "start_condition") if name in data.attrs}
        scene = None
        if "scene" in data.attrs or "provenance_kind" not in data.attrs:
            scene, moments = _scene_of(data)
            attributes |= moments
        else:
            attributes |= {
                name: checks.number(f"data.{name}", data.attrs[name]) for name in OF_RUNS if name in data.attrs
            }

        def tensor(name: str) -> Tensor:
            values = np.array(data[name].values)
            if values.dtype not in (np.float32, np.float64):
                raise checks.FieldTypeError(f"data.{name} must be of float32 or float64, got {values.dtype}")
            return torch.from_numpy(values)

        held = "long_time" in data
        mean, stderr = tensor("band_energy"), tensor("band_energy_stderr")
        counts = tuple(checks.integer("data.block_count", n, 1) for n in np.atleast_1d(data["block_count"].values))
        return cls(
            scene,
            tensor("time") if scene is None else scene.times,
            mean,
            stderr,
            tensor("long_time") if held else None,
            tensor("long_time_stderr") if held else None,
            _decoded(data, mean, stderr, counts) if whole else tensor("block_band_energy"),
            tensor("block_long_time") if held else None,
            counts,
            attributes,
            _provenance_of(data),
            tensor("systematic") if "systematic" in data else None,
            StartTransfer.from_dataset(data),
        )

    def save(self, path: str | Path) -> None:
        """Write netCDF with labeled axes and units; the file appears whole or not at all.

        Raises:
            FieldError: if nothing can be written there.
        """
        checks.instance("path", path, str, Path)
        path = Path(path)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            self.to_dataset().to_netcdf(part, engine="h5netcdf")
            os.replace(part, path)
        except (OSError, ValueError) as error:
            raise checks.fail("path", "be writable", f"{path}: {error}") from None
        finally:
            part.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | Path) -> BandTransfer:
        """A band transfer from the file of :meth:`save`, or transfer.nc of a run.

        Raises:
            FieldError: if the file is not one.
        """
        checks.instance("path", path, str, Path)
        try:
            with xarray.open_dataset(path, engine="h5netcdf") as data:
                return cls.from_dataset(data.load())
        except (OSError, KeyError, RuntimeError) as error:
            words = getattr(error, "strerror", None) or str(error).splitlines()[0]
            raise checks.fail("path", "be a band transfer's netCDF file", f"{path}: {words}") from None

    @classmethod
    def from_energies(
        cls,
        times: Any,
        energies: Any,
        long_time: Any = None,
        provenance: str | Provenance = "",
        starts: Any = None,
    ) -> BandTransfer:
        """A band transfer from band energies of any origin: experiments, or simulations of another code.

        Args:
            times: (time,), in travel times of sound over one particle.
            energies: shares of the energy, (realization, source, time, receiver): where a unit energy that starts in
                the band ``source`` is later.
            long_time: infinite-time average, (source, receiver) if it is exact or (realization, source, receiver). By
                default it is taken over the later half of the times; its standard error then holds the difference
                between the two quarters, as what has not settled would give.
            provenance: where the data come from, in words.
            starts: shares of the energy at time 0, (realization, source, band), for runs that start in several bands at
                once: sources are then runs, as many as there are, and the transfer is their least-squares fit
                (see :func:`torchchain.ensemble.mixed_starts.fit_transfer`).

        Returns:
            BandTransfer whose scene is None; standard errors and blocks are those of the realizations.

        >>> import torch, torchchain as tc
        >>> times = torch.arange(0.0, 20.0)
        >>> left = 0.5 + 0.5 * torch.exp(-0.3 * times)
        >>> energy = torch.stack([torch.stack([left, 1 - left], -1), torch.stack([1 - left, left], -1)])
        >>> tc.BandTransfer.from_energies(times, energy.expand(5, 2, 20, 2), provenance="two bands").n_bands
        2

        Raises:
            FieldError, FieldTypeError: for times, shapes or numbers that are none of a transfer, energies that are no
                shares or start in another band than their source, and for starts that do not tell the bands apart.

        Warns:
            FramesWarning: for energies that are negative, sum up to more than 1 (scaled to 1), lose what they began
                with, or start in several bands without ``starts``.
        """
        times, energies = checks.times("times", times), checks.real_tensor("energies", energies)
        square = starts is not None or energies.ndim != 4 or energies.shape[1] == energies.shape[3]
        if energies.ndim != 4 or not square or energies.shape[2] != len(times):
            as_many = "" if starts is not None else " and as many sources as receivers"
            rule = f"have the axes (realization, source, time, receiver) with {len(times)} times{as_many}"
            raise checks.fail("energies", rule, f"shape {tuple(energies.shape)}")
        if not len(energies):
            raise checks.fail("energies", "hold at least one realization", "none")
        times, energies = times.detach().cpu().double(), energies.detach().cpu().double()
        if starts is None:
            energies = as_shares(times, energies)
        provenance = _imported(provenance, times, energies)
        if starts is not None:
            starts = checks.real_tensor("starts", starts).detach().cpu().double()
            expected = (*energies.shape[:2], energies.shape[3])
            if tuple(starts.shape) != expected:
                raise checks.fail("starts", f"have shape {expected}", f"shape {tuple(starts.shape)}")
            checks.first_bad("starts", "not be negative by more than a tenth", starts, starts < -0.1, "realization")
            late = None if long_time is None else checks.real_tensor("long_time", long_time).cpu().double()
            per_run = late is not None and late.ndim == 3
            if late is not None and per_run:
                if tuple(late.shape) != expected:
                    raise checks.fail(
                        "long_time", f"have shape {expected[2:] * 2} or {expected}", f"shape {tuple(late.shape)}"
                    )
                late = late.flatten(0, 1)
            realization = torch.arange(len(energies)).repeat_interleave(energies.shape[1])
            flat = starts.flatten(0, 1), energies.flatten(0, 1)
            return _fitted(times, *flat, late, realization, provenance, per_run)
        average, unsettled = (
            _late_average(times, energies) if long_time is None else _given_average(energies, long_time)
        )
        moments = EnsembleMoments(len(energies), min(BLOCKS, len(energies)))
        moments.add(0, {"band_energy": energies, "long_time_band_energy": average})
        transfer = _from_moments(None, times, moments, {}, provenance)
        assert transfer.long_time_stderr is not None
        return replace(transfer, long_time_stderr=(transfer.long_time_stderr.square() + unsettled.square()).sqrt())

    @classmethod
    def from_trajectories(
        cls,
        chains: Chain | Network | Iterable[Chain | Network],
        trajectories: Trajectory | Iterable[Trajectory],
        n_bands: int,
        long_time: Any = None,
        provenance: str | Provenance = "",
        names: Sequence[str] | None = None,
        largest: float | None = None,
    ) -> BandTransfer:
        """A band transfer from the motion of chains or networks, by any code: the bands each run starts in are found.

        Runs that all start in one band each (0.99 of the energy in their first frame) are averaged; of runs that start in
        several bands at once, or leave out some band on some chain, the transfer is the least-squares fit. Runs on
        chains of equal masses are runs of one realization.

        Args:
            chains: one for each run, linear, with an even number of particles; or one with batch axes. Or networks in
                periodic boxes, packings for instance, one for each run.
            trajectories: one for each chain, all with the same times, (*batch, *any, time, particle); may be a generator
                that reads one after the other.
            n_bands: B; of networks the shells of |q| of each polarization, and one band for what is in none of them: see
                :func:`torchchain.network.packing_bands`.
            long_time: infinite-time average, (source, receiver); "late" for that over the later half of the times; by
                default the exact one from the modes of the chains, if all are undamped rings, else "late".
            provenance: where the runs come from, in words.
            names: of the runs, as many, for messages; by default run 1, run 2, ...
            largest: of networks, |q| up to which shells go; by default 2 over the mean bond length of the first.

        Returns:
            BandTransfer whose scene is None, with the attributes ``mass_mean``, ``mass_sd`` and ``start_condition``.

        >>> import torch, torchchain as tc
        >>> chain = tc.Chain(tc.Disorder(strength=0.3).masses(32, 10, seed=0))
        >>> start = tc.standing_wave(chain, tone=[2, 6, 10, 14])
        >>> path = tc.evolve(chain, start, torch.arange(0.0, 20.0))
        >>> tc.BandTransfer.from_trajectories(chain, path, n_bands=4).mean.shape
        torch.Size([4, 20, 4])

        Raises:
            FieldError, FieldTypeError: naming the run, for one whose times or particles are not those of the first or that
                has no energy; and for starts that leave out a band or do not tell the bands apart.

        Warns:
            FramesWarning: naming run and frame, for energy that drifts on a chain without damping.
        """
        n_bands = checks.integer("n_bands", n_bands, 1)
        if isinstance(long_time, str):
            checks.choice("long_time", long_time, ("late",))
        runs = gathered(chains, trajectories, n_bands, long_time is None, names, largest)
        late = runs.long_time if long_time is None or isinstance(long_time, str) else long_time
        attributes = {"mass_mean": float(runs.masses.mean()), "mass_sd": float(runs.masses.std(correction=0))}
        table = runs.table()
        if table is not None:
            late = runs.long_time[table] if runs.long_time is not None else late
            made = cls.from_energies(runs.times, runs.energies[table], late, provenance)
            return replace(made, attributes={**attributes, "start_condition": 1.0})
        if late is not None:
            late = checks.real_tensor("long_time", late).cpu().double()
        origin = _imported(provenance, runs.times, runs.energies)
        made = _fitted(
            runs.times, runs.starts, runs.energies, late, runs.realization, origin, runs.long_time is not None
        )
        return replace(made, attributes={**made.attributes, **attributes})


def _decoded(data: xarray.Dataset, mean: Tensor, stderr: Tensor, counts: tuple[int, ...]) -> Tensor:
    """The block means of a file that holds them as whole steps."""
    missed = data["block_steps"].values
    if missed.dtype.kind != "i":
        raise checks.FieldTypeError(f"data.block_steps must be of integers, got {missed.dtype}")
    expected = (len(counts), *mean.shape)
    if mean.ndim != 3 or missed.shape != expected or stderr.shape != mean.shape:
        raise checks.fail("data.block_steps", f"have shape {expected}", f"shape {missed.shape}")
    return decoded(missed, mean.double(), stderr.double(), counts)


def _imported(provenance: str | Provenance, times: Tensor, energies: Tensor) -> Provenance:
    """Where the data come from, with the hash of the numbers."""
    if not isinstance(provenance, Provenance):
        checks.instance("provenance", provenance, str)
        provenance = Provenance("imported", provenance)
    numbers = hashlib.sha256(energies.contiguous().numpy().tobytes() + times.numpy().tobytes())
    return replace(provenance, hashes={**provenance.hashes, "energies": numbers.hexdigest()})


def _fitted(
    times: Tensor,
    starts: Tensor,
    energies: Tensor,
    late: Tensor | None,
    realization: Tensor,
    provenance: Provenance,
    per_run: bool,
) -> BandTransfer:
    """The least-squares transfer of runs (run, band), (run, time, band); long-time averages go through the same fit.

    Args:
        times, starts, energies, realization, provenance, per_run: of the runs.
        late: with ``per_run`` (run, band); else (source, receiver), which is taken as exact; None for the later half of
            the times.
    """
    n, ends = energies.shape[2], [energies[:, :0]]
    if late is None:
        later = energies[:, 2 * times >= times[-1]]
        halves = [part if part.shape[1] else later for part in later.tensor_split(2, dim=1)]
        ends += [part.mean(1, keepdim=True) for part in (later, *halves)]
    elif per_run:
        ends += [late[:, None]]
    elif tuple(late.shape) != (n, n):
        raise checks.fail("long_time", f"have shape {(n, n)} (source, receiver)", f"shape {tuple(late.shape)}")
    found = fit_transfer(starts, torch.cat([energies, *ends], 1), realization)
    count = len(times)
    given = late is not None and not per_run
    average = late if given else found.mean[:, count]
    error = torch.zeros(n, n, dtype=torch.float64) if given else found.stderr[:, count]
    blocks = found.block_mean[:, :, count] if not given else torch.as_tensor(late).expand(len(found.block_counts), n, n)
    if late is None:
        unsettled = (found.mean[:, count + 2] - found.mean[:, count + 1]) / 2
        error = (error.square() + unsettled.square()).sqrt()
    mean = found.mean[:, :count].contiguous()
    block_mean, stderr = rounded(found.block_mean[:, :, :count], mean, found.stderr[:, :count], found.block_counts)
    return BandTransfer(
        None, times, mean, stderr, average, error, block_mean,
        blocks, found.block_counts, {"start_condition": found.condition}, provenance,
    )  # fmt: skip


def _given_average(energies: Tensor, long_time: Any) -> tuple[Tensor, Tensor]:
    """A given long-time average of every realization, and what else it may be off by: nothing."""
    given = checks.real_tensor("long_time", long_time).cpu().double()
    shape = (len(energies), energies.shape[1], energies.shape[3])
    if tuple(given.shape) not in (shape, shape[1:]):
        raise checks.fail("long_time", f"have shape {shape[1:]} or {shape}", f"shape {tuple(given.shape)}")
    return given.expand(shape), torch.zeros(shape[1:], dtype=torch.float64)


def _late_average(times: Tensor, energies: Tensor) -> tuple[Tensor, Tensor]:
    """The mean over the later half of the times of every realization, and half of how far its two quarters differ."""
    late = energies[:, :, 2 * times >= times[-1]]
    first, second = late.tensor_split(2, dim=2)
    unsettled = (
        (second.mean((0, 2)) - first.mean((0, 2))).abs() / 2 if second.shape[2] else torch.zeros(late.shape[1::2])
    )
    return late.mean(2), unsettled.double()


def _scene_of(data: xarray.Dataset) -> tuple[Scene, dict[str, Any]]:
    """The scene of a simulation's dataset, and the moments of its masses."""
    for name in ("scene", "mass_mean", "mass_sd"):
        if name not in data.attrs:
            raise checks.fail("data", f"have the attribute {name} of a band transfer", "none")
    try:
        scene = Scene.from_dict(tomllib.loads(str(data.attrs["scene"])))
    except (ValueError, RecursionError) as error:
        raise checks.fail("data", "have the attribute scene of a band transfer", str(error)) from None
    if "time" in data.coords and not np.array_equal(data["time"].values, scene.times.numpy()):
        raise checks.fail("data", "have the times of its scene", checks.shown(data["time"].values))
    return scene, {name: checks.number(f"data.{name}", data.attrs[name]) for name in ("mass_mean", "mass_sd")}


def _provenance_of(data: xarray.Dataset) -> Provenance | None:
    """What a dataset says of its origin; None in files written before they did."""
    if "provenance_kind" not in data.attrs:
        return None
    try:
        hashes = json.loads(str(data.attrs.get("provenance_hashes", "{}")))
    except ValueError as error:
        raise checks.fail("data", "have the attribute provenance_hashes as JSON", str(error)) from None
    return Provenance(str(data.attrs["provenance_kind"]), str(data.attrs.get("provenance", "")), hashes)


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
        ranks: processes that share the realizations, from :func:`torchchain.ranks.process_group`; each gets the result.
        starts: also measure the transfer from other tones of each band and from kicks, of undamped, linear rings with 16 samples
            and more: a model calibrated on it takes any start in space. It adds about a third to the cost.

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
    if isinstance(method, str) and method == THEORY:
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
    with single_thread(), stages("statistics"):
        found = _from_moments(scene, scene.times, ensemble.moments, ensemble.attributes, None)
        found = _by_species(found, ensemble.moments) if scene.by_species else found
        found = with_late_average(found) if long_time and len(observables) == 1 else found
    if not starts or not measurable(scene):
        return found
    other = None if checkpoint is None else Checkpoint(checkpoint.folder / "starts", checkpoint.every)
    return replace(found, starts=start_transfer(scene, ensemble.method, ensemble.options, other, **settings))


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
    return ("band_energy", *(("long_time_band_energy",) if long_time and exact and not scene.by_species and scene.largest_damping == 0 else ()))


def with_late_average(transfer: BandTransfer) -> BandTransfer:
    """The long-time average over the later half of the times, its error that of the block means and of not having settled."""
    average, unsettled = _late_average(transfer.times, transfer.mean[None])
    blocks, _ = _late_average(transfer.times, transfer.block_mean)
    weights = torch.tensor(transfer.block_counts, dtype=blocks.dtype)[:, None, None]
    squares = (weights * (blocks - average).square()).sum(0)
    error = (
        (squares / weights.sum() / max(len(blocks) - 1, 1)).sqrt()
        if len(blocks) > 1
        else torch.full_like(squares, torch.inf)
    )
    if transfer.is_ordered:
        error = torch.zeros_like(squares)
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


def _from_moments(
    scene: Scene | None, times: Tensor, moments: EnsembleMoments, attributes: dict[str, Any],
    provenance: Provenance | None,
) -> BandTransfer:  # fmt: skip
    """The BandTransfer of the blocks' moments in time and at infinite time."""
    is_ordered = scene is not None and scene.is_ordered
    blocks = moments.blocks("band_energy")
    total = merged(blocks)
    ends = moments.blocks("long_time_band_energy") if "long_time_band_energy" in moments.names else []
    end: Moments | None = merged(ends) if ends else None
    counts = tuple(block.count for block in blocks)
    stacked = torch.stack([block.mean for block in blocks])
    block_mean, stderr = rounded(stacked, total.mean, ordered_error(is_ordered, total), counts)
    return BandTransfer(
        scene,
        times,
        total.mean,
        stderr,
        end.mean if end else None,
        ordered_error(is_ordered, end) if end else None,
        block_mean,
        torch.stack([block.mean for block in ends]) if ends else None,
        counts,
        attributes,
        provenance,
    )


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
