"""The fields of a band transfer from moments of an ensemble, from band energies, or from motion of any origin."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.ensemble.block_means import rounded
from torchchain.ensemble.imported import as_shares, gathered
from torchchain.ensemble.labels import ordered_error
from torchchain.ensemble.layout import BLOCKS
from torchchain.ensemble.mixed_starts import fit_transfer
from torchchain.ensemble.provenance import Provenance, of_energies
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import EnsembleMoments, Moments, merged
from torchchain.network import Network


def of_moments(
    scene: Scene | None, times: Tensor, moments: EnsembleMoments, attributes: dict[str, Any],
    provenance: Provenance | None,
) -> dict[str, Any]:  # fmt: skip
    """The fields of the transfer from the blocks' moments in time and at infinite time."""
    is_ordered = scene is not None and scene.is_ordered
    blocks = moments.blocks("band_energy")
    total = merged(blocks)
    ends = moments.blocks("long_time_band_energy") if "long_time_band_energy" in moments.names else []
    end: Moments | None = merged(ends) if ends else None
    counts = tuple(block.count for block in blocks)
    stacked = torch.stack([block.mean for block in blocks])
    block_mean, stderr = rounded(stacked, total.mean, ordered_error(is_ordered, total), counts)
    return {
        "scene": scene,
        "times": times,
        "mean": total.mean,
        "stderr": stderr,
        "long_time": end.mean if end else None,
        "long_time_stderr": ordered_error(is_ordered, end) if end else None,
        "block_mean": block_mean,
        "block_long_time": torch.stack([block.mean for block in ends]) if ends else None,
        "block_counts": counts,
        "attributes": attributes,
        "provenance": provenance,
    }


def from_energies(
    times: Any, energies: Any, long_time: Any, provenance: str | Provenance, starts: Any
) -> dict[str, Any]:
    """For :meth:`torchchain.BandTransfer.from_energies`."""
    times, energies = checks.times("times", times), checks.real_tensor("energies", energies)
    square = starts is not None or energies.ndim != 4 or energies.shape[1] == energies.shape[3]
    if energies.ndim != 4 or not square or energies.shape[2] != len(times):
        as_many = "" if starts is not None else " and as many sources as receivers"
        rule = f"have the axes (realization, source, time, receiver) with {len(times)} times{as_many}"
        raise checks.fail("energies", rule, energies)
    if not len(energies):
        raise checks.fail("energies", "hold at least one realization", "none")
    times, energies = times.detach().cpu().double(), energies.detach().cpu().double()
    if starts is None:
        energies = as_shares(times, energies)
    provenance = of_energies(provenance, times, energies)
    if starts is not None:
        expected = (*energies.shape[:2], energies.shape[3])
        starts = checks.shaped("starts", starts, expected).detach().cpu().double()
        checks.first_bad("starts", "not be negative by more than a tenth", starts, starts < -0.1, "realization")
        late = None if long_time is None else checks.real_tensor("long_time", long_time).cpu().double()
        per_run = late is not None and late.ndim == 3
        if late is not None and late.ndim == 3:
            late = _shaped(late, expected, expected[2:] * 2).flatten(0, 1)
        realization = torch.arange(len(energies)).repeat_interleave(energies.shape[1])
        flat = starts.flatten(0, 1), energies.flatten(0, 1)
        return of_runs(times, *flat, late, realization, provenance, per_run)
    if long_time is None:
        average, unsettled = late_average(times, energies)
    else:
        shape = (len(energies), energies.shape[1], energies.shape[3])
        average = _shaped(checks.real_tensor("long_time", long_time).cpu().double(), shape, shape[1:]).expand(shape)
        unsettled = torch.zeros(shape[1:], dtype=torch.float64)
    moments = EnsembleMoments(len(energies), min(BLOCKS, len(energies)))
    moments.add(0, {"band_energy": energies, "long_time_band_energy": average})
    found = of_moments(None, times, moments, {}, provenance)
    return found | {"long_time_stderr": (found["long_time_stderr"].square() + unsettled.square()).sqrt()}


def from_trajectories(
    chains: Chain | Network | Iterable[Chain | Network], trajectories: Trajectory | Iterable[Trajectory], n_bands: int,
    long_time: Any, provenance: str | Provenance, names: Sequence[str] | None, largest: float | None,
) -> dict[str, Any]:  # fmt: skip
    """For :meth:`torchchain.BandTransfer.from_trajectories`."""
    n_bands = checks.integer("n_bands", n_bands, 1)
    if isinstance(long_time, str):
        checks.choice("long_time", long_time, ("late",))
    runs = gathered(chains, trajectories, n_bands, long_time is None, names, largest)
    late = runs.long_time if long_time is None or isinstance(long_time, str) else long_time
    attributes = {"mass_mean": float(runs.masses.mean()), "mass_sd": float(runs.masses.std(correction=0))}
    table = runs.table()
    if table is not None:
        late = runs.long_time[table] if runs.long_time is not None else late
        made = from_energies(runs.times, runs.energies[table], late, provenance, None)
        return made | {"attributes": {**attributes, "start_condition": 1.0}}
    if late is not None:
        late = checks.real_tensor("long_time", late).cpu().double()
    origin = of_energies(provenance, runs.times, runs.energies)
    made = of_runs(runs.times, runs.starts, runs.energies, late, runs.realization, origin, runs.long_time is not None)
    return made | {"attributes": {**made["attributes"], **attributes}}


def of_runs(
    times: Tensor,
    starts: Tensor,
    energies: Tensor,
    late: Tensor | None,
    realization: Tensor,
    provenance: Provenance,
    per_run: bool,
) -> dict[str, Any]:
    """The fields of the least-squares transfer of runs (run, band), (run, time, band); long-time averages go through the same fit.

    Args:
        times, starts, energies, realization, provenance, per_run: of the runs.
        late: with ``per_run`` (run, band); else (source, receiver), which is taken as exact; None for the later half of
            the times.
    """
    n, count, ends = energies.shape[2], len(times), [energies[:, :0]]
    if late is None:
        later = energies[:, 2 * times >= times[-1]]
        halves = [part if part.shape[1] else later for part in later.tensor_split(2, dim=1)]
        ends += [part.mean(1, keepdim=True) for part in (later, *halves)]
    elif per_run:
        ends += [late[:, None]]
    elif tuple(late.shape) != (n, n):
        raise checks.fail("long_time", f"have shape {(n, n)} (source, receiver)", late)
    found = fit_transfer(starts, torch.cat([energies, *ends], 1), realization)
    if late is not None and not per_run:
        average, error, blocks = late, torch.zeros_like(late), late.expand(len(found.block_counts), n, n)
    else:
        average, error, blocks = found.mean[:, count], found.stderr[:, count], found.block_mean[:, :, count]
    if late is None:
        unsettled = (found.mean[:, count + 2] - found.mean[:, count + 1]) / 2
        error = (error.square() + unsettled.square()).sqrt()
    mean = found.mean[:, :count].contiguous()
    block_mean, stderr = rounded(found.block_mean[:, :, :count], mean, found.stderr[:, :count], found.block_counts)
    return {
        "scene": None, "times": times, "mean": mean, "stderr": stderr, "long_time": average, "long_time_stderr": error,
        "block_mean": block_mean, "block_long_time": blocks, "block_counts": found.block_counts,
        "attributes": {"start_condition": found.condition}, "provenance": provenance,
    }  # fmt: skip


def _shaped(late: Tensor, *shapes: tuple[int, ...]) -> Tensor:
    """A long-time average that is given, of one of the shapes."""
    if tuple(late.shape) not in shapes:
        rule = f"have shape {' or '.join(str(shape) for shape in reversed(shapes))}"
        raise checks.fail("long_time", rule, late)
    return late


def late_average(times: Tensor, energies: Tensor) -> tuple[Tensor, Tensor]:
    """The mean over the later half of the times of every realization, and half of how far its two quarters differ."""
    late = energies[:, :, 2 * times >= times[-1]]
    first, second = late.tensor_split(2, dim=2)
    unsettled = (
        (second.mean((0, 2)) - first.mean((0, 2))).abs() / 2 if second.shape[2] else torch.zeros(late.shape[1::2])
    )
    return late.mean(2), unsettled.double()
