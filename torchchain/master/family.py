"""One artifact for a range of disorder: models calibrated at several strengths, and any strength between."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.ensemble.statistics import total_variation
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master import file
from torchchain.master.calibration import calibrate, recipe, replicates
from torchchain.master.compact import CompactModel
from torchchain.master.compact_family import (
    WEAKEST,
    at_strength,
    between,
    calibrate_together,
    errors_between,
    joined,
    scene_of,
)
from torchchain.master.compact_family import weights as compact_weights
from torchchain.master.compact_record import COMPACT, CompactReport
from torchchain.master.equation import MasterEquation
from torchchain.master.memory import MemoryModel
from torchchain.master.model import TransferModel
from torchchain.master.report import Loss, Report
from torchchain.master.starts import StartModel, can_fit, fit_starts, with_errors
from torchchain.master.starts import between as between_starts
from torchchain.master.uncertainty import Uncertainty, of_parts

NEIGHBORS = 4
SHARED = (
    "n_particles", "n_bands", "boundary", "contact", "damping", "stiffness_disorder", "species", "arrangement", "unlike",
    "by_species",
)  # fmt: skip
"""Fields of their scenes in which members are alike."""
MOST_KEPT = 8
"""Master equations between the members that a family keeps, the last asked for."""


class MasterFamily(Printed):
    """Master equations of the same bands and chains for several strengths xi of the disorder.

    Compact models are fitted together, with coefficients that are the theory's of every strength, where it describes the chains,
    and polynomials of sqrt(xi): a strength between them has its own, which is never negative and conserves energy. Members that were calibrated alone are first fitted together to
    what they predict.

    Of models with memory alone (of damped chains, say) the transfer at a strength between is a weighted sum of those of up
    to four neighbors, with the weights of Lagrange's polynomial in log xi, at every time. They add up to 1, so that
    energy is conserved as exactly as by the members, and at time 0 every band has its own energy. Below the lowest
    strength the other neighbor is the chain without disorder, in which nothing moves, with the weight
    1 - (xi / lowest)^2: to leading order what weak disorder moves is proportional to xi^2 at every time.

    Args:
        members: compact models or models with memory, of different strengths.

    Raises:
        FieldError: if they differ in more than the strength of the disorder.

    Example:
        >>> scenes = [tc.Scene(n_particles=32, n_bands=4, realizations=40, disorder=tc.Disorder(strength=xi)) for xi in (0.1, 0.2)]
        >>> transfers = [tc.band_transfer(scene, method="modes") for scene in scenes]
        >>> family = tc.MasterFamily([tc.calibrate(t, model="memory", order=(1, 1), bootstrap=0) for t in transfers])
        >>> family.strengths, family.at(0.15).n_bands
        ((0.1, 0.2), 4)
    """

    def __init__(self, members: Sequence[MasterEquation]) -> None:
        if not isinstance(members, (list, tuple)):
            raise checks.FieldTypeError(f"members must be a list of master equations, got {checks.shown(members)}")
        if not members:
            raise checks.fail("members", "be at least one master equation", 0)
        for member in members:
            checks.instance("members", member, MasterEquation)
            if member.calibration.scene is None:
                raise checks.fail(
                    "members", "be calibrated on chains of a scene", member.calibration.provenance or "no scene"
                )
        self.members = tuple(sorted(members, key=lambda member: scene_of(member).disorder.strength))
        self._kept: dict[float, MasterEquation] = {}
        first = scene_of(self.members[0])
        for member in self.members:
            scene = scene_of(member)
            if not isinstance(member.model, (CompactModel, MemoryModel)):
                raise checks.fail("members", "have the model 'compact' or 'memory'", repr(member.calibration.model))
            for name in SHARED:
                if getattr(scene, name) != getattr(first, name):
                    both = f"{getattr(first, name)} and {getattr(scene, name)}"
                    raise checks.fail("members", f"have the same {name}", both)
            if replace(scene.disorder, strength=first.disorder.strength) != first.disorder:
                raise checks.fail("members", "differ in the strength of their disorder only", f"{scene.disorder}")
        found = self.strengths
        if any(b <= a for a, b in pairwise(found)) or found[0] == 0:
            raise checks.fail("members", "have different strengths above 0", list(found))
        if any(isinstance(member.model, CompactModel) for member in self.members) and not self._sets:
            self.members = tuple(joined(self.members))

    @property
    def _sets(self) -> int:
        """Polynomials of sqrt(xi) that the members' coefficients are made of, 0 if they were not fitted together."""
        reports = [member.calibration.report.fit for member in self.members]
        if not all(isinstance(report, CompactReport) for report in reports) or len({*reports}) > 1:
            return 0
        return int(reports[0].sets)

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        each = sum(member.n_parameters for member in self.members)
        return each * self._sets // len(self.members) if self._sets else each

    @property
    def strengths(self) -> tuple[float, ...]:
        """xi of the members, increasing."""
        return tuple(scene_of(member).disorder.strength for member in self.members)

    def weights(self, strength: float) -> dict[float, float]:
        """Weight of every member, by its strength, and of the chain without disorder, 0.0, at a strength."""
        strength = checks.number("strength", strength, at_least=0)
        known = self.strengths
        if strength > known[-1] * (1 + 1e-12):
            raise checks.fail("strength", f"be at most {known[-1]:g}, the largest calibrated", strength)
        strength = min(strength, known[-1])
        if strength in known:
            return {strength: 1.0}
        if self._sets:
            shares = compact_weights(max(strength, WEAKEST), known, self._sets)
            return dict(zip(known, map(float, shares), strict=True))
        if strength < known[0]:
            share = (strength / known[0]) ** 2
            return {0.0: 1 - share, known[0]: share}
        place = next(i for i, other in enumerate(known) if other > strength)
        begin = max(0, min(place - NEIGHBORS // 2, len(known) - NEIGHBORS))
        near = known[begin : begin + NEIGHBORS]
        return {
            a: math.prod(math.log(strength / b) / math.log(a / b) for b in near if b != a)
            for a in near
        }  # fmt: skip

    def at(self, strength: float) -> MasterEquation:
        """The master equation at a strength from 0 to the largest calibrated; of any start only from the lowest on.

        Raises:
            FieldError: for a larger one.
        """
        weights = self.weights(strength)
        chosen = dict(zip(self.strengths, self.members, strict=True))
        if len(weights) == 1:  # a member's own strength
            return chosen[next(iter(weights))]
        strength = float(strength)
        if strength not in self._kept:
            found = self._joined(strength, weights)
            found.starts = self._starts(scene_of(found))
            self._kept = dict([*self._kept.items(), (strength, found)][-MOST_KEPT:])
        return self._kept[strength]

    def _starts(self, scene: Scene) -> StartModel | None:
        """The model of starts in space from the members on either side; none below the lowest, where it was far off."""
        known, strength = self.strengths, scene.disorder.strength
        above = sum(xi <= strength for xi in known)
        if above == 0 or above == len(known):
            return None
        (low, first), (high, last) = ((known[i], self.members[i].starts) for i in (above - 1, above))
        return None if first is None or last is None else between_starts((low, first), (high, last), scene)

    def _joined(self, strength: float, weights: dict[float, float]) -> MasterEquation:
        """At a strength that no member has."""
        parts = [
            (weights[xi], member) for xi, member in zip(self.strengths, self.members, strict=True) if xi in weights
        ]
        members = [member for _, member in parts]
        record = members[0].calibration
        scene = at_strength(scene_of(members[0]), strength)
        report = Report(interpolated=tuple(weights.items()), horizon=min(member.horizon for member in members))
        model: TransferModel
        if self._sets:  # of compact models
            model = between(members, scene, self._sets)
            told = record.report
            report = replace(report, fit=told.fit, bootstrap=told.bootstrap, certificate=model.certificate)
            errors = errors_between(members, model, scene, self._sets)
        else:
            model = _combined(parts, weights.get(0.0, 0.0))
            report = replace(report, loss=_combined_loss([(w, m.calibration.report.loss) for w, m in parts]))
            errors = _combined_errors(parts)
        return MasterEquation(model, replace(record, scene=scene, report=report), errors)

    def solve(self, initial: Any, times: Any, strength: float, method: str = "expm", **options: Any) -> Tensor:
        """Band energies at a strength; see :meth:`MasterEquation.solve`."""
        return self.at(strength).solve(initial, times, method, **options)

    def leave_one_out(self, times: Any) -> list[tuple[float, float]]:
        """What interpolation costs: each inner member's strength, and its total variation from the others' prediction.

        Args:
            times: at which they are compared, (time,); the mean is over these and all sources.
        """
        times = checks.times("times", times).to(self.members[0].rates)
        found = []
        for i in range(1, len(self.members) - 1):
            member = self.members[i]
            rest = (*self.members[:i], *self.members[i + 1 :])
            others = MasterFamily(joined(rest) if self._sets else rest)
            strength = self.strengths[i]
            there = others.at(strength).model.transfer(times)
            found.append((strength, float(total_variation(there, member.model.transfer(times)).mean())))
        return found

    def save(self, path: str | Path) -> None:
        """Write all members to one safetensors file, all or nothing."""
        file.save_family([(m.model, m.calibration, m.uncertainty, m.starts) for m in self.members], path)

    @classmethod
    def load(cls, path: str | Path) -> MasterFamily:
        """Read a saved family; every field is checked.

        Raises:
            FieldError: naming the file and what is wrong with it.
        """
        return cls([MasterEquation(*member) for member in file.load_family(path)])

    def _rows(self) -> dict[str, str]:
        first, found = self.members[0], self.strengths
        return {
            "members": f"{len(found)}, at disorder {', '.join(f'{xi:g}' for xi in found)}",
            "predicts at": f"any disorder from 0 to {found[-1]:g}: family.at(strength), family.solve(initial, times, strength)",
            "bands": f"{first.n_bands}",
            "models": "; ".join(member.model.words for member in self.members),
            "first calibrated on": describe(scene_of(first)),
            "compared with chains": f"up to t = {min(member.horizon for member in self.members):g}",
        }


def calibrate_family(transfers: Sequence[BandTransfer], **settings: Any) -> MasterFamily:
    """Calibrate compact models on all transfers at once, or a model with memory on each, and join them.

    Args:
        transfers: of ensembles that differ in the strength of their disorder (and in seeds, realizations and times).
        settings: ``degrees`` in place, distance and time, ``window`` and ``bootstrap`` as in :func:`torchchain.calibrate`.
            With ``order``, and for chains that the compact model cannot describe (damped, say), models with memory.

    Returns:
        MasterFamily, ``at(strength)`` of which is a MasterEquation.

    Example:
        >>> scenes = [tc.Scene(n_particles=32, n_bands=4, realizations=40, disorder=tc.Disorder(strength=xi)) for xi in (0.1, 0.2)]
        >>> transfers = [tc.band_transfer(scene, method="modes") for scene in scenes]
        >>> family = tc.calibrate_family(transfers, order=(1, 1), bootstrap=0)
        >>> family.at(0.15).transfer([0.0, 10.0]).shape[0]
        4
    """
    if not isinstance(transfers, (list, tuple)) or not transfers:
        raise checks.FieldTypeError(f"transfers must be a list of band transfers, got {checks.shown(transfers)}")
    for transfer in transfers:
        checks.instance("transfers", transfer, BandTransfer)
    if "order" in settings or not all(COMPACT.describes(transfer.scene) for transfer in transfers):
        return MasterFamily([calibrate(transfer, "projection", "memory", **settings) for transfer in transfers])
    checks.known_keys("settings", settings, ("degrees", "window", "bootstrap"))
    asked = [recipe(transfer, "logistic", "compact", window=settings.get("window")) for transfer in transfers]
    counts = [replicates(settings.get("bootstrap"), asked[0].fit, transfer) for transfer in transfers]
    members = calibrate_together(transfers, asked[0].window, min(counts), settings.get("degrees"))
    for transfer, member in zip(transfers, members, strict=True):
        if can_fit(transfer):
            starts = fit_starts(transfer)
            errors = member.uncertainty
            member.starts = starts if errors is None else with_errors(starts, transfer, errors)
    return MasterFamily(members)


def _combined(parts: Sequence[tuple[float, MasterEquation]], idle: float) -> MemoryModel:
    """The weighted sum of models with memory, and of the chain in which nothing moves with the weight ``idle``."""
    models = [(weight, member.model) for weight, member in parts if isinstance(member.model, MemoryModel)]
    single = [weight * model.amplitudes[: len(model.decay)] for weight, model in models]
    paired = [weight * model.amplitudes[len(model.decay) :] for weight, model in models]

    def joined(name: str) -> Tensor:
        return torch.cat([getattr(model, name) for _, model in models])

    rates, basis = (_summed((weight, getattr(model, name)) for weight, model in models) for name in ("rates", "basis"))
    return MemoryModel(
        rates=rates.detach(), basis=basis + idle * torch.eye(len(basis), dtype=basis.dtype),
        amplitudes=torch.cat([*single, *paired]),
        **{name: joined(name) for name in ("decay", "pair_decay", "pair_frequency")},
    )  # fmt: skip


def _combined_loss(losses: Sequence[tuple[float, Loss | None]]) -> Loss | None:
    """The weighted sum of the damping of members."""
    held = [(weight, loss) for weight, loss in losses if loss is not None]
    if len(held) < len(losses):
        return None
    rates = _summed((weight, torch.tensor(loss.rates, dtype=torch.float64)) for weight, loss in held)
    return Loss(tuple(rates.clamp(min=0).tolist()), max(loss.misfit for _, loss in held))


def _combined_errors(parts: Sequence[tuple[float, MasterEquation]]) -> Uncertainty | None:
    """Errors of the weighted sum: by noise those of different members are independent, by misfit alike; sources err as in the first member."""
    held = [(weight, member.uncertainty) for weight, member in parts if member.uncertainty is not None]
    if len(held) < len(parts):
        return None
    times = held[0][1].times
    split = [(weight, *errors.parts(times)) for weight, errors in held]

    rates, basis = (
        _summed((1.0, (weight * getattr(errors, name)).square()) for weight, errors in held).sqrt()
        for name in ("rates_stderr", "basis_stderr")
    )
    by_noise = _summed((weight**2, noise) for weight, noise, _ in split)
    by_misfit = _summed((weight, misfit.sqrt()) for weight, _, misfit in split).square()
    return of_parts(rates, basis, times, by_noise, by_misfit, held[0][1].alike)


def _summed(parts: Iterable[tuple[float, Tensor]]) -> Tensor:
    """A weighted sum."""
    return torch.stack([weight * value for weight, value in parts]).sum(0)
