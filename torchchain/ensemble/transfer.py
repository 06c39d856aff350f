"""The transfer of energy between wavenumber bands, averaged over an ensemble: simulated, or from data of any origin."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchchain import checks, plots
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.ensemble import transfer_fields
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.starts import StartTransfer
from torchchain.ensemble.transfer_data import dataset_of, fields_of
from torchchain.network import Network

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes


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
            raise checks.fail("mean", "have the axes [source, time, receiver]", self.mean)
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
                raise checks.fail(name, f"have shape {shape}", value)
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
        starts = {}
        if self.starts is not None:
            starts["starts"] = f"{len(self.starts.tones)} tones released and kicked, {self.starts.samples} samples"
        method = {"evolved by": str(self.attributes["method"])} if "method" in self.attributes else {}
        return {
            "origin": " ".join(filter(None, (f"{self.provenance.kind}:", self.provenance.words or "not told"))),
            "axes": f"source {self.n_bands}, time {len(self.times)}, receiver {self.n_bands}",
            "times": f"{self.times[0]:g} to {self.times[-1]:g}",
            "samples": f"{sum(self.block_counts)} in {len(self.block_counts)} blocks",
            "mean": f"standard error up to {self.stderr.max():.1e}",
            "long_time": known,
            **starts,
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
        return dataset_of(self)

    @classmethod
    def from_dataset(cls, data: xarray.Dataset) -> BandTransfer:
        """The inverse of :meth:`to_dataset`.

        Raises:
            FieldError, FieldTypeError: for a dataset that is not of a band transfer.
        """
        return cls(**fields_of(data))

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
        import xarray

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
        return cls(**transfer_fields.from_energies(times, energies, long_time, provenance, starts))

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
        return cls(
            **transfer_fields.from_trajectories(chains, trajectories, n_bands, long_time, provenance, names, largest)
        )
