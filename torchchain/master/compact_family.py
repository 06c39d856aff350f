"""Compact models of several strengths of disorder, fitted together: their coefficients are the theory's and polynomials of sqrt(xi).

The theory of disorder is exact at early times and near at late ones: what chains have to tell beyond it changes slowly with xi.
Where it does not describe the chains, the polynomials are of the coefficients themselves: D is proportional to xi^2.
Any coefficients make a model that is never negative and conserves energy, so every strength in between has one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.compact import CompactModel
from torchchain.master.compact_record import (
    CompactReport,
    check_scene,
    drawn_again,
    loss_tensors,
    redrawn,
    regression_of,
    shares_of,
)
from torchchain.master.derived import THEORY, TheoryModel, compared
from torchchain.master.equation import MasterEquation
from torchchain.master.fits import linear_weights
from torchchain.master.logistic import fit_compact, solve, stepped
from torchchain.master.misfit import model_error
from torchchain.master.polynomials import checked_degrees, n_coefficients
from torchchain.master.report import Calibration, Report
from torchchain.master.sample import Sample
from torchchain.master.theory_rings import derived
from torchchain.master.uncertainty import Uncertainty, block_draws, combined, horizon, of_parts
from torchchain.master.waves import Waves
from torchchain.threads import single_blas_thread

DEGREES = (9, 6, 14)  # in place, distance and time
SETS = 5
"""Polynomials of sqrt(xi), at most: 1,410 fitted numbers with these degrees."""
STIFFNESS = 1000.0
"""Ridge of the first of them, relative to that of a model alone; the next have 4, 9, 16 times as much."""
THEORY_TIMES = torch.cat([
    torch.tensor([0.01, 0.03, 0.06, 0.1, 0.15]), torch.linspace(0.2, 3, 13), torch.logspace(math.log10(3.5), math.log10(400), 36),
]).double()  # fmt: skip
THEORY_ERROR = 0.01
"""Distance to which the theory is followed, of the energy that has moved."""
BELOW = (10, 7, 20)
"""Degrees of models below the lowest member, whose coefficients are derived and not fitted to chains."""
SCATTERINGS = 10.0
"""xi^2 tan^2(k/2) t from which on what the theory misses grows no more."""
LEAST = 1e-12
"""Share of the energy that odds are told from."""
WEAKEST = 1e-9
"""In place of no disorder, where nothing moves."""

THEORY_WEAKEST = 1e-3
"""Weakest disorder of which the theory is asked for coefficients: the energy that leaves a band, some xi^2, nears rounding."""


def polynomials_of(strengths: Sequence[float], known: Sequence[float], sets: int) -> np.ndarray:
    """Chebyshev's polynomials in sqrt(xi) from the lowest to the highest known strength, (strength, set).

    Of strengths that grow by a like factor, say, polynomials in xi itself swing between the highest.
    """
    low, high = math.sqrt(known[0]), math.sqrt(known[-1])
    x = (2 * np.sqrt(strengths) - low - high) / max(high - low, 1e-12)
    return np.polynomial.chebyshev.chebvander(np.clip(x, -1, 1), sets - 1)


def weights(strength: float, known: Sequence[float], sets: int) -> np.ndarray:
    """Weight of the coefficients of each known strength at another, (strength,); they add up to 1.

    Below the lowest, the lowest's own hold.
    """
    return polynomials_of([strength], known, sets)[0] @ np.linalg.pinv(polynomials_of(known, known, sets))


def between(
    members: Sequence[MasterEquation], scene: Scene, sets: int, power: int = 2, guide: Tensor | None = None
) -> CompactModel:
    """The model of a scene whose strength may lie between those of members that were fitted together.

    Where the theory of disorder describes the chains, what the coefficients differ from it by is a polynomial; below the lowest
    strength see :func:`_below`. Elsewhere they go to zero below it as xi^2, for D is perturbation theory, exact in that limit. What damped chains have left is a mixture of that of the nearest two strengths.

    Args:
        members: in order of their strengths.
        scene: of which a model is wanted.
        sets: polynomials of sqrt(xi).
        power: of xi, by which what a model leaves out falls below the lowest strength.
        guide: what the theory says of the scene, where it is known.
    """
    known = [member.calibration.strength or WEAKEST for member in members]
    strength = max(scene.disorder.strength, WEAKEST)
    tensors = [{name: x for name, x in member.model.tensors().items() if name != "guide"} for member in members]

    def summed(name: str, shares: Sequence[float]) -> Tensor:
        return torch.stack([share * each[name].double() for share, each in zip(shares, tensors, strict=True)]).sum(0)

    near = nearest(strength, known)
    other = scene.stiffness_disorder
    beside = 0.0 if other is None else other.strength
    waves = Waves.of(at_strength(scene, strength))
    mixed = {name: summed(name, near) for name in ("rates", "loss")}
    degrees = checked_degrees([int(degree) for degree in tensors[0]["degrees"]])
    told = max(strength, THEORY_WEAKEST)
    fewer = (told**2 + beside**2) / (known[0] ** 2 + beside**2)
    if strength < known[0] and _described(scene):
        mixed["coefficients"] = _fitted(
            at_strength(scene, told), _below(members[0], at_strength(scene, told), _fit_times()), BELOW
        )
        mixed["coefficients"] *= (strength / told) ** power
        mixed["degrees"] = torch.tensor(BELOW, dtype=torch.float64)
    elif strength < known[0]:
        mixed["coefficients"] = summed("coefficients", near) * fewer ** (power / 2) * (strength / told) ** power
    else:
        shares = weights(strength, known, sets).tolist()
        mixed["guide"] = _guide(scene, degrees) if guide is None else guide
        mixed["coefficients"] = mixed["guide"] + summed("coefficients", shares)
        for share, member in zip(shares, members, strict=True):
            mixed["coefficients"] = mixed["coefficients"] - share * _known_guide(member, degrees)
    return CompactModel(**tensors[0] | mixed | waves.tensors())


def scene_of(member: MasterEquation) -> Scene:
    """The scene that a member was calibrated on."""
    scene = member.calibration.scene
    assert scene is not None, "a family's constructor has checked it"
    return scene


def at_strength(scene: Scene, strength: float) -> Scene:
    """The same chains with another strength of the masses' disorder."""
    return replace(scene, disorder=replace(scene.disorder, strength=strength))


def _described(scene: Scene) -> bool:
    """Whether the theory of disorder can guide the models of a scene's strengths."""
    return not scene.damping and compared(scene) and THEORY.describes(scene)


def _below(lowest: MasterEquation, scene: Scene, times: Tensor, power: int = 2) -> Tensor:
    """T at a strength below the lowest: of the theory, its odds mended by some of what the lowest model tells of it."""
    model, there = lowest.model, scene_of(lowest)
    assert isinstance(model, CompactModel), "a family's constructor has checked it"
    own = model.at(times.to(model.rates)).double()
    missed = [_odds(found).log() for found in (own, derived(TheoryModel.of(there).ring, times))]
    share = _shared(there, scene, times) ** (power / 2)
    odds = _odds(derived(TheoryModel.of(scene).ring, times)) * (share * (missed[0] - missed[1])).exp()
    return odds / odds.sum(-1, keepdim=True)


def _shared(lowest: Scene, scene: Scene, times: Tensor) -> Tensor:
    """How much of what the theory misses of the odds at the lowest strength it misses at a smaller one, [source, time, receiver].

    That grows as the variance of the masses at first, and where waves have been scattered back no longer.
    """
    k = 2 * math.pi / scene.n_particles * torch.tensor(scene.tones, dtype=torch.float64)
    rate = lowest.disorder.strength**2 * torch.tan(k.clamp(max=0.99 * math.pi) / 2).square()[:, None] / SCATTERINGS
    fewer = (scene.disorder.strength / lowest.disorder.strength) ** 2
    share = fewer * (1 + rate * times) / (1 + fewer * rate * times)  # [band, time]
    share = torch.where(times.isinf(), torch.ones_like(share), share)
    return (share[:, :, None] * share.T).sqrt()


def _odds(transfer: Tensor) -> Tensor:
    """Of the bands against the source's own, [source, time, receiver]."""
    transfer = transfer.clamp(min=LEAST)
    return transfer / transfer.diagonal(dim1=0, dim2=2).T[..., None]


def _guide(scene: Scene, degrees: tuple[int, int, int]) -> Tensor:
    """Coefficients of the compact form for what the theory of disorder says of a scene's chains; zero if nothing."""
    if not _described(scene):
        return torch.zeros(n_coefficients(degrees), dtype=torch.float64)
    return _fitted(scene, derived(TheoryModel.of(scene).ring, _fit_times()), degrees)


def _known_guide(member: MasterEquation, degrees: tuple[int, int, int]) -> Tensor:
    """That of a member's chains, which it holds if it was fitted in a family with these degrees."""
    model = member.model
    if isinstance(model, CompactModel) and len(model.guide) and model.degrees_ == degrees:
        return model.guide
    return _guide(scene_of(member), degrees)


def _fit_times() -> Tensor:
    return torch.cat([THEORY_TIMES, THEORY_TIMES.new_tensor([math.inf])])


def _fitted(scene: Scene, transfer: Tensor, degrees: tuple[int, int, int]) -> Tensor:
    """Coefficients of the compact form for a transfer at ``THEORY_TIMES`` and in the end."""
    with single_blas_thread():
        moved = 1 - transfer[:, :-1].diagonal(dim1=0, dim2=2).mean(-1)
        model, _ = fit_compact(
            transfer[:, 0], Waves.of(scene), degrees, THEORY_TIMES, transfer[:, :-1], transfer[:, -1],
            THEORY_ERROR * moved,
        )  # fmt: skip
    return model.coefficients


def nearest(strength: float, known: Sequence[float]) -> list[float]:
    """Weight of each known strength: linear in log xi between the nearest two, the lowest's alone below it."""
    place = float(np.interp(math.log(max(strength, WEAKEST)), np.log(known), np.arange(len(known))))
    return [max(0.0, 1 - abs(place - i)) for i in range(len(known))]


class Together:
    """Regressions of chains that differ in the strength of their masses' disorder.

    Args:
        samples: of the chains, in order of it.
        guides: what the theory says of each sample, (sample, coefficient).
        degrees: of the polynomials in place, distance and time.
        sets: polynomials of sqrt(xi), no more than there are samples.
    """

    def __init__(
        self, samples: Sequence[Sample], guides: np.ndarray, degrees: tuple[int, int, int], sets: int = SETS
    ) -> None:
        strengths = [sample.strength or WEAKEST for sample in samples]
        self._samples, self._guides, self._degrees = samples, guides, degrees
        self._mixing = polynomials_of(strengths, strengths, min(sets, len(strengths)))
        self._stiffness = STIFFNESS * np.arange(self._mixing.shape[1]) ** 2.0
        self._problems = [
            regression_of(sample, degrees).guided(guide) for sample, guide in zip(samples, guides, strict=True)
        ]

    def fit(self, rates: Sequence[Tensor]) -> tuple[list[CompactModel], CompactReport]:
        """The model of every sample, with these rates for comparison, and how the regression went."""
        with single_blas_thread():
            start = None if self._guides.any() else self._start()  # what the theory says is near enough
            self._found, told = solve(self._problems, self._mixing, start, None, self._stiffness)
        rows = self._guides + self._mixing @ self._found
        models = [
            CompactModel(
                rates=slopes, degrees=torch.tensor(self._degrees, dtype=torch.float64), coefficients=torch.from_numpy(row),
                guide=torch.from_numpy(guide), **Waves.of(sample.chains).tensors(), **loss_tensors(sample),
            )
            for sample, slopes, row, guide in zip(self._samples, rates, rows, self._guides, strict=True)
        ]  # fmt: skip
        return models, CompactReport(**told, degrees=self._degrees, sets=self._mixing.shape[1])

    def _start(self) -> np.ndarray:
        """The common coefficients nearest to those of every regression alone, in units of their errors, (set, coefficient)."""
        matrix: Any = 0.0
        pull: Any = 0.0
        alone = None
        for problem, m in zip(self._problems, self._mixing, strict=True):
            alone, _ = solve([problem], np.ones((1, 1)), alone)  # from the solution of the strength before
            table = problem.table(alone[0])
            square, _ = problem.normal(problem.predicted(table), table)
            matrix = matrix + np.einsum("s,z,ab->sazb", m, m, square)
            pull = pull + np.outer(m, square @ alone[0])
        square = matrix.reshape(pull.size, -1) + np.diag(np.repeat(self._stiffness, pull.shape[1]))
        return np.linalg.solve(square, pull.ravel()).reshape(pull.shape)

    def redrawn(self, drawn: Sequence[Tensor]) -> np.ndarray:
        """Coefficients for T of ensembles drawn again, by one step from the solution each, (sample, replica, coefficient)."""
        shares = [shares_of(each) for each in drawn]
        found = stepped(self._problems, self._mixing, self._found, shares, self._stiffness)
        return self._guides[:, None] + np.einsum("ms,rsc->mrc", self._mixing, found)


def calibrate_together(
    transfers: Sequence[BandTransfer], window: tuple[float, float], replicates: int,
    degrees: tuple[int, int, int] | None = None, sets: int = SETS,
) -> list[MasterEquation]:  # fmt: skip
    """Compact models of ensembles of several strengths, in order of them, with error bars by bootstrap of all at once.

    Args:
        transfers: of ensembles that differ in the strength of their masses' disorder.
        window: of the slopes that are kept for comparison.
        replicates: ensembles drawn again, 0 for no error bars.
        degrees, sets: see :class:`Together`.
    """
    for transfer in transfers:
        check_scene(transfer.scene)
    transfers = sorted(transfers, key=lambda transfer: Sample.of(transfer).strength or 0.0)
    degrees = DEGREES if degrees is None else checked_degrees(degrees)
    samples = [Sample.of(transfer) for transfer in transfers]
    together = Together(
        samples, np.stack([_guide(sample.chains, degrees).numpy() for sample in samples]), degrees, sets
    )
    slopes = [torch.einsum("t,str->sr", linear_weights(s.times, window), s.distribution().mean) for s in samples]
    models, told = together.fit(slopes)
    errors: list[Uncertainty] | list[None] = [None] * len(models)
    if replicates:  # of one step from the solution each
        repeats = [block_draws(len(transfer.block_counts), replicates, i) for i, transfer in enumerate(transfers)]
        drawn = [drawn_again(transfer, repeat) for transfer, repeat in zip(transfers, repeats, strict=True)]
        errors = [
            combined(transfer, model, redrawn(transfer, model, window, repeat, *rest), repeat)
            for transfer, model, repeat, *rest in zip(transfers, models, repeats, drawn, together.redrawn(drawn), strict=True)
        ]  # fmt: skip
    return [
        MasterEquation(
            model,
            Calibration("logistic", "compact", window, transfer.scene, Report(
                fit=told, horizon=horizon(transfer, model), bootstrap=replicates, certificate=model.certificate,
            )),
            error,
        )
        for transfer, model, error in zip(transfers, models, errors, strict=True)
    ]  # fmt: skip


def joined(members: Sequence[MasterEquation]) -> list[MasterEquation]:
    """Models that were calibrated each alone, fitted together to what they predict, weighted by their error bars."""
    degrees = max((m.model.degrees_ for m in members if isinstance(m.model, CompactModel)), key=sum)
    degrees = min(degrees, DEGREES, key=sum)
    guides = np.stack([_known_guide(member, degrees).numpy() for member in members])
    together = Together([_seen(member) for member in members], guides, degrees)
    models, told = together.fit([member.rates.detach() for member in members])
    again = []
    for member, model in zip(members, models, strict=True):
        errors = member.uncertainty
        if errors is not None:
            before, now = (each.transfer(errors.times).detach() for each in (member.model, model))
            noise, misfit = errors.parts(errors.times)
            off = model_error(now, before, errors.stderr, torch.zeros_like(now))
            errors = of_parts(
                errors.rates_stderr, errors.basis_stderr, errors.times, noise, misfit + off.square(), errors.alike
            )
        record = member.calibration
        report = replace(record.report, fit=told, certificate=model.certificate)
        again.append(MasterEquation(model, replace(record, method="logistic", model="compact", report=report), errors))
    return again


def _seen(member: MasterEquation) -> Sample:
    """What a model predicts, as a sample of its chains."""
    scene, errors = scene_of(member), member.uncertainty
    times, damped = scene.times if errors is None else errors.times, scene.damping > 0
    late = None if damped else member.basis.detach()
    return Sample(
        times, member.model.transfer(times).detach(), late, scene.disorder.strength, damped, scene,
        None if errors is None else errors.stderr,
    )  # fmt: skip


def errors_between(
    members: Sequence[MasterEquation], model: CompactModel, scene: Scene, sets: int
) -> Uncertainty | None:
    """Error bars of the model of a scene between those of members: theirs, and by how much interpolation may be off.

    Errors of the odds are those of a mixture of the nearest two strengths': by noise they are independent, by what models of this form miss
    alike, and of sources alike as at the nearer. What interpolation is off by is the distance to a polynomial of sqrt(xi) of one degree less.
    """
    held = [(member, member.uncertainty) for member in members if member.uncertainty is not None]
    if len(held) < len(members):
        return None
    known, strength = [member.calibration.strength or WEAKEST for member in members], scene.disorder.strength
    shares = nearest(strength, known)
    guided = strength < known[0] and _described(scene)
    told = at_strength(scene, max(strength, THEORY_WEAKEST))
    nearer = held[shares.index(max(shares))][1]
    times, eye = nearer.times, torch.eye(model.n_bands, dtype=torch.float64)
    here = model.transfer(times).detach()
    noise, missed, slopes, bases = (torch.zeros_like(x) for x in (here, here, eye, eye))
    for weight, (member, errors) in zip(shares, held, strict=True):
        if weight:
            scale = weight * _odds_slope(here) / _odds_slope(member.model.transfer(times).detach())
            late = weight * _odds_slope(model.basis) / _odds_slope(member.basis.detach())
            by_noise, by_misfit = errors.parts(times)
            noise += by_noise * scale.square()
            missed += by_misfit.sqrt() * scale
            bases += (errors.basis_stderr * late).square()
            slopes += (weight * errors.rates_stderr).square()
    less = _shared(at_strength(scene, known[0]), told, times) if guided else torch.ones_like(here)
    noise, misfit = noise * less.square(), (missed * less).square()
    if strength not in known and sets > 1:
        guide = model.guide if len(model.guide) else None
        lower = (
            _below(members[0], told, times, 1)
            if guided
            else between(members, scene, sets - 1, 1, guide).transfer(times)
        )
        misfit += model_error(here, lower.detach(), (noise + misfit).sqrt(), torch.zeros_like(here)).square()
    return of_parts(slopes.sqrt(), bases.sqrt(), times, noise, misfit, nearer.alike)


def _odds_slope(share: Tensor) -> Tensor:
    """By how much a share of the energy changes with the logarithm of its odds."""
    return (share * (1 - share)).clamp(min=1e-30)
