"""What becomes of any start in space: a small model of the transfer from every tone, released or kicked.

A start (u0, v0) of a linear chain has energies that are quadratic in it. Averaged over an ensemble of rings, in which all
places and both directions are alike, no two wavenumbers mix:

    e_r(t) = sum_n  P_n T[n, r](t) + K_n T'[n, r](t) + G_n dT'[n, r]/dt,

with P and K the potential and kinetic energies of tone n, and G = Re(u* v) its virial, which vanishes for traveling waves.
T belongs to waves released at rest, T' to kicked ones (:mod:`torchchain.master.tones`). That the two meet in the derivative
of T' is exact: a moment after the kick v0 the state is (v0 dt, v0).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from torchchain import checks
from torchchain.energy.start_energy import StartEnergy
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.starts import KINDS, StartTransfer
from torchchain.ensemble.statistics import statistical_distance
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.alike import variance
from torchchain.master.logistic import BEYOND, chosen_times, solve
from torchchain.master.misfit import model_error
from torchchain.master.polynomials import checked_degrees, n_coefficients
from torchchain.master.tones import ONSET, ToneRegression, Tones, shares
from torchchain.master.uncertainty import Uncertainty, interpolated
from torchchain.master.waves import whole_strength
from torchchain.threads import single_blas_thread

DEGREES = (12, 8, 16)
"""In place, distance and time; with fewer times fewer in time."""
STEP = 1e-3
"""Of the derivative by time, relative to the time at which the state is looked at, and in time units at most."""
TOGETHER = 2**22
"""Pairs of tones times times that are computed at once."""
FOLLOWED = (0.37, 0.16)
"""Share of the data's variance that a fit follows at least, in the source's own band and in others: by how much, squared, the
models of two ensembles differ (seeds 0 and 1 of `experiments/any_start.py`, no other chains)."""
NEARBY = 0.2
"""Share of a time by which errors are looked at before and after it, for their derivative."""
LEAST = 1e-30
"""Variance below which there is none."""
EVENNESS = 0.5
"""Weight of a source's own error in a fit, rather than of the mean over sources."""


class StartModel(nn.Module):
    """T of waves released at rest and of kicked ones, for every tone of a ring and every time t >= 0.

    Both are never negative. T adds up to 1 over the bands, T' to 1 less the small share that is at k = 0, which
    :meth:`lost` tells. Computed in double precision.

    Args:
        degrees: of the polynomials in place, distance and time, (3,).
        released, kicked: their coefficients, (term,).
        frequency, decay: of the waves of tones 1 to N / 2, (tone,).
        coupling: variance of the disorder for each tone.
        n_bands: B.
        scale_times, scale: errors of T and T' over those of the bands' own model, in the source's own band and in others,
            at some times, (start_time,) and (kind, part, start_time); no times if unknown.
        rigid, onset: as of :class:`torchchain.master.tones.Tones`; 0 in files that do not know them.
        stderr: errors of T and T' at these times, [kind, source, start_time, receiver]; of no times in files that have
            ``scale`` alone.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=torch.linspace(0, 50, 51))
        >>> starts = tc.calibrate(tc.band_transfer(scene), model="memory").starts
        >>> starts.n_particles, starts.n_bands
        (64, 8)
    """

    AXES: ClassVar[dict[str, tuple[str, ...]]] = {
        "degrees": ("degree",), "released": ("term",), "kicked": ("term",), "frequency": ("start_tone",), "decay": ("start_tone",),
        "coupling": (), "scale_times": ("start_time",), "scale": ("kind", "part", "start_time"), "rigid": (), "onset": (),
        "stderr": ("kind", "band", "error_time", "band"),
    }  # fmt: skip
    SHARES: ClassVar[tuple[str, ...]] = ("rigid", "onset")
    OPTIONAL: ClassVar[tuple[str, ...]] = (*SHARES, "stderr")
    released: Tensor
    kicked: Tensor
    frequency: Tensor
    scale_times: Tensor
    scale: Tensor
    stderr: Tensor

    def __init__(
        self, degrees: Tensor, released: Tensor, kicked: Tensor, frequency: Tensor, decay: Tensor, coupling: Tensor,
        scale_times: Tensor, scale: Tensor, n_bands: int, rigid: Tensor | None = None, onset: Tensor | None = None,
        stderr: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        degrees = checks.real_tensor("starts.degrees", degrees)
        self.degrees = checked_degrees([int(value) for value in degrees.flatten()])
        size, count = n_coefficients(self.degrees), len(frequency)
        shapes = {
            "released": (released, (size,)), "kicked": (kicked, (size,)), "frequency": (frequency, (count,)),
            "decay": (decay, (count,)), "coupling": (coupling, ()), "scale_times": (scale_times, (len(scale_times),)),
            "scale": (scale, (2, 2, len(scale_times))),
            **{name: (coupling.new_zeros(()) if x is None else x, ()) for name, x in (("rigid", rigid), ("onset", onset))},
            "stderr": (coupling.new_zeros(2, n_bands, 0, n_bands) if stderr is None else stderr, (2, n_bands, 0 if stderr is None else len(scale_times), n_bands)),
        }  # fmt: skip
        for name, (value, shape) in shapes.items():
            value = checks.shaped(f"starts.{name}", value, shape).double()
            if name in ("frequency", "decay", "coupling"):
                checks.first_bad(f"starts.{name}", "be positive", value, ~(value > 0), "tone")
            if name in self.SHARES and not (float(value) >= 0 and (name == "onset" or float(value) <= 0.25)):
                raise checks.fail(f"starts.{name}", "be a share of the energy", float(value))
            self.register_buffer(name, value.detach().clone())
        if not count or count % n_bands:
            raise checks.fail("starts.frequency", f"hold tones of {n_bands} bands alike", count)
        if not bool((self.stderr >= 0).all()):
            raise checks.fail("starts.stderr", "not be negative", float(self.stderr.min()))
        if not bool((self.scale >= 0).all()) or not bool((self.scale_times.diff() > 0).all()):
            raise checks.fail("starts.scale", "hold factors at increasing times", "others")
        self.n_bands = n_bands

    def _apply(self, fn: Any, recurse: bool = True) -> StartModel:
        """Moved to a device, not to another precision: derivatives by time need double."""
        super()._apply(lambda value: fn(value).double() if value.is_floating_point() else fn(value), recurse)
        return self

    def tensors(self) -> dict[str, Tensor]:
        """All that makes the model but ``n_bands``, as its constructor takes it."""
        every = {name: getattr(self, name) for name in self.AXES}
        return every | {"degrees": self.released.new_tensor(self.degrees), "stderr": self.stderr.float()}

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        return len(self.released) + len(self.kicked)

    @property
    def n_particles(self) -> int:
        """N, of the rings."""
        return 2 * len(self.frequency)

    @property
    def _tones(self) -> Tones:
        names = ("frequency", "decay", "coupling", *self.SHARES)
        return Tones(**{name: self.get_buffer(name) for name in names}, n_bands=self.n_bands)

    def transfer(self, kind: str, tones: Any, times: Tensor) -> Tensor:
        """T [tone, time, receiver] of some tones, counted from 1.

        Args:
            kind: "released" or "kicked".
            tones: integers.
            times: (time,), not negative.
        """
        checks.choice("kind", kind, KINDS)
        numbers = torch.tensor([checks.integer("tones", tone, 1, self.n_particles // 2) - 1 for tone in tones])
        return self._shares(kind, numbers.to(self.released.device), times.to(self.released))

    def _shares(self, kind: str, numbers: Tensor, times: Tensor) -> Tensor:
        coefficients = self.released if kind == KINDS[0] else self.kicked
        window = max(1, TOGETHER // (len(numbers) * len(self.frequency)))
        parts = [shares(self._tones, kind, self.degrees, coefficients, numbers, part) for part in times.split(window)]
        return torch.cat(parts, 1)

    def solve(self, start: StartEnergy, times: Tensor) -> Tensor:
        """Energies (*batch, time, band) after a start; that at k = 0 is in no band."""
        self.check(start)
        times = times.to(self.released)
        energy = self.released.new_zeros(*start.rigid.shape, len(times), self.n_bands)
        for values, transfer in self._parts(start, times):
            energy = energy + torch.einsum("...s,str->...tr", values, transfer)
        return energy

    def lost(self, start: StartEnergy, times: Tensor) -> Tensor:
        """Energy (*batch, time) that has gone to k = 0 and is in no band; with it and ``start.rigid`` energy is conserved."""
        self.check(start)
        times = times.to(self.released)
        every = torch.arange(start.kinetic.shape[-1], device=times.device)
        change, length = _change(partial(self._tones.lost, every), times)
        gone = start.kinetic.to(times) @ self._tones.lost(every, times)
        return gone + start.virial.to(times) @ (change / length)

    def _parts(self, start: StartEnergy, times: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Energies of tones that start with some, and what becomes of a unit of each."""
        for name in ("potential", "kinetic", "virial"):
            values = getattr(start, name).to(self.released)
            used = (values.reshape(-1, values.shape[-1]) != 0).any(0).nonzero()[:, 0]
            if len(used) and name == "virial":
                change, length = _change(partial(self._shares, KINDS[1], used), times)
                yield values[..., used], change / length[:, None]
            elif len(used):
                yield values[..., used], self._shares(KINDS[name == "kinetic"], used, times)

    def standard_error(self, start: StartEnergy, times: Tensor, uncertainty: Uncertainty) -> Tensor:
        """Standard error of :meth:`solve`, (*batch, time, band), from that of the bands' own model.

        Tones of one band have the same error, released or kicked, whose derivative by time is that of the virial's part;
        those of bands are alike as in the bands' own model.
        """
        self.check(start)
        times = times.to(self.released)
        width = start.potential.shape[-1] // self.n_bands
        values = [getattr(start, name).to(self.released) for name in ("potential", "kinetic", "virial")]
        energies = [x.reshape(*x.shape[:-1], self.n_bands, width).sum(-1) for x in values]
        errors = [self._errors(row, times, uncertainty) for row in range(len(KINDS))]
        before, after = (1 - NEARBY) * times, (1 + NEARBY) * times
        change = self._errors(1, after, uncertainty) - self._errors(1, before, uncertainty)
        errors.append(change / (after - before).clamp(min=torch.finfo(times.dtype).tiny)[:, None])
        pairs = list(zip(energies, errors, strict=True))
        return variance(pairs, uncertainty.shared(times)).sqrt()

    def _errors(self, row: int, times: Tensor, uncertainty: Uncertainty) -> Tensor:
        """Standard error of T or T', [source, time, receiver]; before the first known time it grows as t^2."""
        known = self.scale_times
        if not self.stderr.shape[2]:  # as a factor to that of the bands' own model, in older files
            each = uncertainty.at(times)
            if not len(known):
                return each
            own = torch.eye(self.n_bands, device=times.device)[:, None].expand_as(each) > 0
            inside, outside = (interpolated(known, self.scale[row, part][None, :, None], times) for part in range(2))
            return each * torch.where(own, inside, outside)
        early = (times / known[0]).clamp(max=1).square()
        return interpolated(known, self.stderr[row], times) * early[:, None]

    def check(self, start: StartEnergy) -> None:
        """An error for a start on rings of another length."""
        if start.n_particles != self.n_particles:
            raise checks.fail(
                "initial", f"be a start on {self.n_particles} particles, as calibrated", start.n_particles
            )


def _change(of: Callable[[Tensor], Tensor], times: Tensor) -> tuple[Tensor, Tensor]:
    """By how much a function of the times changes about each, and in which time, (time,)."""
    step = STEP * (1 + times).clamp(max=10.0)
    before = (times - step).clamp(min=0)
    return of(times + step) - of(before), times + step - before


def can_fit(transfer: BandTransfer) -> bool:
    """Whether a transfer tells of other starts, and of disorder from which their model follows."""
    return transfer.starts is not None and transfer.scene is not None and not transfer.is_ordered


def _told(transfer: BandTransfer) -> tuple[Scene, StartTransfer]:
    """The chains and their other starts of a transfer that tells of them."""
    assert transfer.scene is not None and transfer.starts is not None, "can_fit has said so"  # noqa: PT018
    return transfer.scene, transfer.starts


def fit_starts(transfer: BandTransfer) -> StartModel:
    """The model of a transfer's starts; a second for 32 bands.

    Waves released at rest also see the calibrated tones of the ensemble at all of its times. Where its long-time average
    is known both kinds are held to it: what kicks then differ by is taken from the last time.
    """
    scene, starts = _told(transfer)
    tones = _tones(scene)
    degrees = (*DEGREES[:2], max(2, min(DEGREES[2], (len(starts.times) - 1) // 2)))
    numbers, own = (torch.tensor(found) - 1 for found in (starts.tones, scene.tones))
    later = starts.times > 0
    center = torch.isin(numbers, own)
    picked = chosen_times(transfer.times)
    whole = transfer.times[picked], transfer.mean[:, picked].double(), transfer.stderr[:, picked].double()
    late = transfer.long_time if len(picked) else None
    coefficients: dict[str, Any] = {}
    with single_blas_thread():
        for kind in KINDS:
            mean, stderr = _in_bands(getattr(starts, kind))[:, later], getattr(starts, f"{kind}_stderr")[:, later]
            told = [(numbers, starts.times[later], mean, stderr)]
            if kind == KINDS[0] and len(picked):
                told = [(numbers[~center], starts.times[later], mean[~center], stderr[~center]), (own, *whole)]
            if late is not None:
                end, error = late.double(), whole[2][:, -1:]
                if kind == KINDS[1]:
                    end = (end + mean[center, -1] - starts.released[center, -1]).clamp(min=0)
                    end, error = end / end.sum(-1, keepdim=True), stderr[center, -1:]
                beyond = transfer.times.new_tensor([*BEYOND, math.inf])
                shape = (-1, len(beyond), -1)
                told.append((own, transfer.times[-1] * beyond, end[:, None].expand(shape), error.expand(shape)))
            problems = [
                ToneRegression(tones, kind, degrees, which, times, data, _weights(error))
                for which, times, data, error in told
                if len(which)
            ]
            found, _ = solve(problems, np.ones((len(problems), 1)))
            coefficients[kind] = torch.from_numpy(found[0])
    none = torch.zeros(0, dtype=torch.float64)
    return StartModel(
        torch.tensor(degrees, dtype=torch.float64), **coefficients, scale_times=none, scale=none.expand(2, 2, 0), **vars(tones)
    )  # fmt: skip


def _tones(scene: Scene) -> Tones:
    return Tones.of(scene.n_particles, scene.n_bands, whole_strength(scene), scene.disorder.strength)


def between(lower: tuple[float, StartModel], upper: tuple[float, StartModel], scene: Scene) -> StartModel | None:
    """The model of a scene whose disorder lies between those of two models.

    What is fitted changes linearly with the logarithm of the strength. Errors are the larger of both.

    Args:
        lower, upper: strength and model.
        scene: its masses and contacts, of a strength between.

    Returns:
        None for models of different forms.
    """
    (low, first), (high, last) = lower, upper
    known = {float(model.get_buffer("onset")) for model in (first, last)} == {ONSET}
    if first.degrees != last.degrees or not torch.equal(first.scale_times, last.scale_times) or not known:
        return None
    part, tones = math.log(scene.disorder.strength / low) / math.log(high / low), _tones(scene)
    mixed = {kind: torch.lerp(getattr(first, kind), getattr(last, kind), part) for kind in KINDS}
    own = {name: value for name, value in vars(tones).items() if name != "n_bands"}
    errors = {"scale": torch.maximum(first.scale, last.scale)}
    if first.stderr.shape == last.stderr.shape:
        errors["stderr"] = torch.maximum(first.stderr, last.stderr)
    return StartModel(**first.tensors() | mixed | own | errors, n_bands=first.n_bands)


def _in_bands(mean: Tensor) -> Tensor:
    """Shares of the energy that is in a band, whatever a kick has left at k = 0."""
    return mean / mean.sum(-1, keepdim=True)


def _weights(stderr: Tensor) -> Tensor:
    """Inverse of the error of each energy, (source, time), from the standard errors (source, time, band)."""
    distance = statistical_distance(stderr)
    distance = distance.clamp(min=max(1e-9 * float(distance.max()), 1e-300))
    mean = distance.mean(0) ** (1 - EVENNESS) * distance**EVENNESS
    return stderr.shape[-1] / math.sqrt(math.pi) / mean


def with_errors(model: StartModel, transfer: BandTransfer, uncertainty: Uncertainty) -> StartModel:
    """The model with its errors: what it misses its data by beyond their noise, and the share of that noise that it has followed.

    Fits of waves released at rest follow as much as the bands' own model, of kicked ones, and in bands other than the source's
    where it is told from misfit, as much as ``FOLLOWED`` says.
    """
    scene, starts = _told(transfer)
    times, n = starts.times[1:], scene.n_bands
    base = uncertainty.at(times.double()).square()
    numbers, own = torch.tensor(starts.tones) - 1, torch.eye(n, dtype=torch.bool)[:, None].expand_as(base)
    center = torch.isin(numbers, torch.tensor(scene.tones) - 1)
    sets = [center, ~center] if bool((~center).any()) else [center]
    scale, stderrs = torch.ones(len(KINDS), 2, len(times), dtype=torch.float64), []
    least = torch.where(own, *FOLLOWED)
    shares = _followed(uncertainty, starts.released_stderr[center, 1:], times), least
    for row, kind in enumerate(KINDS):
        error = torch.zeros_like(base)
        for one in sets:
            found = model.transfer(kind, (numbers[one] + 1).tolist(), times)
            mean, stderr = (getattr(starts, name)[one, 1:] for name in (kind, f"{kind}_stderr"))
            followed = shares[row].sqrt() * stderr
            noise = (1 - torch.where(own, shares[row], least)).sqrt() * stderr
            error += (followed.square() + model_error(found, mean, stderr, noise).square()) / len(sets)
        stderrs.append(error.sqrt().float().double())  # known to a few per cent
        for column, part in enumerate((own, ~own)):
            here, there = ((x * part).sum((0, 2)) for x in (error, base))
            scale[row, column] = (here / there.clamp(min=LEAST)).sqrt()
    errors = {"scale_times": times, "scale": scale, "stderr": torch.stack(stderrs)}
    return StartModel(**model.tensors() | errors, n_bands=n)


def _followed(uncertainty: Uncertainty, stderr: Tensor, times: Tensor) -> Tensor:
    """Share of the data's variance that a fit follows, [source, time, receiver]: what the bands' own model follows, at these times.

    At first all bands lose energy as one sum over the chain's masses is by chance, which every fit follows.

    Args:
        uncertainty: of the bands' own model.
        stderr: of the energies that it was fitted to, [source, time, receiver].
        times: (time,).
    """
    noise, _ = uncertainty.parts(times.double())
    found = torch.where(stderr > 0, noise / stderr.square().clamp(min=LEAST), torch.zeros_like(noise)).transpose(0, 1)
    own = torch.eye(len(stderr), dtype=torch.bool)
    inside, outside = (
        found[:, part].median(-1).values.clamp(least, 1)[None, :, None]
        for part, least in zip((own, ~own), FOLLOWED, strict=True)
    )
    return torch.where(own[:, None], inside, outside)
