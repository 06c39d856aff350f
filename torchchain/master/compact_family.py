"""Compact models of several strengths of disorder, fitted together: their coefficients are polynomials of sqrt(xi).

The waves of a strength are known, and D is proportional to xi^2: what the coefficients have to tell changes slowly with xi.
Any coefficients make a model that is never negative and conserves energy, so every strength in between has one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain.ensemble.scene import Scene
from torchchain.ensemble.statistics import statistical_distance
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.compact import CompactModel, checked_degrees, n_coefficients
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
from torchchain.master.logistic import Regression, fit_compact, solve, stepped
from torchchain.master.misfit import model_error
from torchchain.master.report import Calibration, Report
from torchchain.master.sample import Sample
from torchchain.master.uncertainty import Uncertainty, block_draws, combined, horizon
from torchchain.master.waves import Waves
from torchchain.threads import single_blas_thread

DEGREES = (9, 6, 14)
SETS = 5
"""Polynomials of sqrt(xi), at most: 1,410 fitted numbers with these degrees."""
STIFFNESS = 1000.0
"""Ridge of the first of them, relative to that of a model alone; the next have 4, 9, 16 times as much."""
THEORY_TIMES = torch.cat([torch.linspace(0.25, 3, 12), torch.logspace(math.log10(3.5), math.log10(400), 36)]).double()
THEORY_FROM = (5.0, 50.0)
"""Before the first of these times perturbation theory is exact to more digits than the theory has, from the second on it is not."""
THEORY_ERROR = 0.3
"""Distance to which the theory is followed, of the energy that has moved: for coefficients that are small, and change slowly."""
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


def between(members: Sequence[MasterEquation], scene: Scene, sets: int, power: int = 2) -> CompactModel:
    """The model of a scene whose strength may lie between those of members that were fitted together.

    Below the lowest strength the coefficients go to zero as xi^2, for D is perturbation theory, exact in that limit, and what
    it leaves out is of order xi^2 t; where the theory of disorder describes the chains, what goes to zero is the difference
    from its own coefficients. What damped chains have left is a mixture of that of the nearest two strengths.
    """
    known = [member.calibration.strength or WEAKEST for member in members]
    strength = max(scene.disorder.strength, WEAKEST)
    tensors = [member.model.tensors() for member in members]

    def summed(name: str, shares: Sequence[float]) -> Tensor:
        return torch.stack([share * each[name].double() for share, each in zip(shares, tensors, strict=True)]).sum(0)

    near = nearest(strength, known)
    other = scene.stiffness_disorder
    beside = 0.0 if other is None else other.strength
    waves = Waves.of(scene, math.hypot(strength, beside))
    mixed = {name: summed(name, near) for name in ("rates", "loss")}
    mixed["coefficients"] = summed("coefficients", weights(strength, known, sets).tolist())
    if strength < known[0]:
        told = max(strength, THEORY_WEAKEST)
        here, there = (
            _told_by_theory(replace(scene, disorder=replace(scene.disorder, strength=xi)), tensors[0]["degrees"])
            for xi in (told, known[0])
        )
        here = here * (strength / told) ** power
        share = ((strength**2 + beside**2) / (known[0] ** 2 + beside**2)) ** (power / 2)
        mixed["coefficients"] = here + share * (mixed["coefficients"] - there)
    return CompactModel(**tensors[0] | mixed | waves.tensors())


def _told_by_theory(scene: Scene, given: Tensor) -> Tensor:
    """Coefficients, of given degrees, of the compact form for what the theory of disorder says of chains; zero if nothing."""
    degrees = checked_degrees([int(degree) for degree in given])
    if scene.damping or not compared(scene) or not THEORY.describes(scene):
        return torch.zeros(n_coefficients(degrees), dtype=torch.float64)
    times = torch.cat([THEORY_TIMES, THEORY_TIMES.new_tensor([math.inf])])
    none = torch.zeros(n_coefficients(degrees), dtype=torch.float64)
    plain = CompactModel(
        rates=torch.zeros(scene.n_bands, scene.n_bands, dtype=torch.float64), degrees=given.double(), coefficients=none,
        **Waves.of(scene).tensors(),
    ).at(times)  # fmt: skip
    late = (times.log() - math.log(THEORY_FROM[0])) / math.log(THEORY_FROM[1] / THEORY_FROM[0])
    transfer = torch.lerp(plain, TheoryModel.of(scene).transfer(times), late.clamp(0, 1)[:, None])
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


def fit_together(
    samples: Sequence[Sample], degrees: tuple[int, int, int] = DEGREES, sets: int = SETS,
    progress: Callable[[int], Any] | None = None,
) -> tuple[np.ndarray, CompactReport]:  # fmt: skip
    """Coefficients for every sample, (sample, coefficient), and how the regression went.

    Args:
        samples: of chains that differ in the strength of their masses' disorder, in order of it.
        degrees: of the polynomials in place, distance and time.
        sets: polynomials of sqrt(xi), no more than there are samples.
        progress: called with 1 after every step.
    """
    problems = [regression_of(sample, degrees) for sample in samples]
    mixing = _mixing(samples, sets)
    with single_blas_thread():
        found, told = solve(problems, mixing, _start(problems, mixing, progress), progress, _stiffness(mixing.shape[1]))
    return mixing @ found, CompactReport(told["converged"], told["steps"], told["misfit"], degrees, mixing.shape[1])


def _start(problems: Sequence[Regression], mixing: np.ndarray, progress: Callable[[int], Any] | None) -> np.ndarray:
    """The common coefficients nearest to those of every regression alone, in units of their errors, (set, coefficient)."""
    matrix: Any = 0.0
    pull: Any = 0.0
    alone = None
    for problem, m in zip(problems, mixing, strict=True):
        alone, _ = solve([problem], np.ones((1, 1)), alone, progress)  # from the solution of the strength before
        table = problem.table(alone[0])
        square, _ = problem.normal(problem.predicted(table), table)
        matrix = matrix + np.einsum("s,z,ab->sazb", m, m, square)
        pull = pull + np.outer(m, square @ alone[0])
    square = matrix.reshape(pull.size, -1) + np.diag(np.repeat(_stiffness(len(pull)), pull.shape[1]))
    return np.linalg.solve(square, pull.ravel()).reshape(pull.shape)


def _stiffness(sets: int) -> np.ndarray:
    """Against changes with the strength that the data do not tell, (set,)."""
    return STIFFNESS * np.arange(sets) ** 2.0


def _mixing(samples: Sequence[Sample], sets: int) -> np.ndarray:
    strengths = [sample.strength or WEAKEST for sample in samples]
    return polynomials_of(strengths, strengths, min(sets, len(strengths)))


def calibrate_together(
    transfers: Sequence[BandTransfer], window: tuple[float, float], replicates: int,
    degrees: tuple[int, int, int] | None = None, sets: int = SETS, progress: Callable[[int], Any] | None = None,
) -> list[MasterEquation]:  # fmt: skip
    """Compact models of ensembles of several strengths, in order of them, with error bars by bootstrap of all at once.

    Args:
        transfers: of ensembles that differ in the strength of their masses' disorder.
        window: of the slopes that are kept for comparison.
        replicates: ensembles drawn again, 0 for no error bars.
        degrees, sets, progress: see :func:`fit_together`.
    """
    for transfer in transfers:
        check_scene(transfer.scene)
    transfers = sorted(transfers, key=lambda transfer: Sample.of(transfer).strength or 0.0)
    degrees = DEGREES if degrees is None else checked_degrees(degrees)
    samples = [Sample.of(transfer) for transfer in transfers]
    found, told = fit_together(samples, degrees, sets, progress)
    slopes = [torch.einsum("t,str->sr", linear_weights(s.times, window), s.distribution().mean) for s in samples]
    models = [
        _model(sample, rates, degrees, row) for sample, rates, row in zip(samples, slopes, found, strict=True)
    ]  # fmt: skip
    errors: list[Uncertainty] | list[None] = [None] * len(models)
    if replicates:
        errors = _errors(transfers, samples, models, window, replicates, told.sets)
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


def _model(sample: Sample, rates: Tensor, degrees: tuple[int, int, int], coefficients: np.ndarray) -> CompactModel:
    assert sample.scene is not None, "check_scene has seen it"
    return CompactModel(
        rates=rates, degrees=torch.tensor(degrees, dtype=torch.float64), coefficients=torch.from_numpy(coefficients.copy()),
        **Waves.of(sample.scene).tensors(), **loss_tensors(sample),
    )  # fmt: skip


def _errors(
    transfers: Sequence[BandTransfer], samples: Sequence[Sample], models: Sequence[CompactModel],
    window: tuple[float, float], replicates: int, sets: int,
) -> list[Uncertainty]:  # fmt: skip
    """Error bars of all models: the blocks of every ensemble are drawn again, each time by one step from the solution."""
    repeats = [block_draws(len(transfer.block_counts), replicates, i) for i, transfer in enumerate(transfers)]
    mixing = _mixing(samples, sets)
    problems = [regression_of(sample, models[0].degrees_) for sample in samples]
    found = np.linalg.pinv(mixing) @ np.stack([model.coefficients.numpy() for model in models])
    drawn = [drawn_again(transfer, repeat) for transfer, repeat in zip(transfers, repeats, strict=True)]
    others = np.einsum(
        "ms,rsc->mrc", mixing, stepped(problems, mixing, found, [shares_of(each) for each in drawn], _stiffness(sets))
    )
    return [
        combined(transfer, model, redrawn(transfer, model, window, *rest))
        for transfer, model, *rest in zip(transfers, models, repeats, drawn, others, strict=True)
    ]


def joined(members: Sequence[MasterEquation]) -> list[MasterEquation]:
    """Models that were calibrated each alone, fitted together to what they predict, weighted by their error bars."""
    degrees = max((m.model.degrees_ for m in members if isinstance(m.model, CompactModel)), key=sum)
    samples = [_seen(member) for member in members]
    found, told = fit_together(samples, min(degrees, DEGREES, key=sum))
    again = []
    for member, sample, row in zip(members, samples, found, strict=True):
        model, errors = _model(sample, member.rates.detach(), told.degrees, row), member.uncertainty
        if errors is not None:
            before, now = (each.transfer(errors.times).detach() for each in (member.model, model))
            off = model_error(now, before, errors.stderr, errors.stderr)
            errors = replace(errors, stderr=(errors.stderr.square() + off.square()).sqrt())
        record = member.calibration
        report = replace(record.report, fit=told, certificate=model.certificate)
        again.append(MasterEquation(model, replace(record, method="logistic", model="compact", report=report), errors))
    return again


def _seen(member: MasterEquation) -> Sample:
    """What a model predicts, as a sample of its chains."""
    scene, errors = member.calibration.scene, member.uncertainty
    assert scene is not None, "a family's constructor has checked it"
    times, damped = scene.times if errors is None else errors.times, scene.damping > 0
    late = None if damped else member.basis.detach()
    return Sample(
        times, member.model.transfer(times).detach(), late, scene.disorder.strength, damped, scene,
        None if errors is None else statistical_distance(errors.stderr).mean(0),
    )  # fmt: skip


def errors_between(
    members: Sequence[MasterEquation], model: CompactModel, scene: Scene, sets: int
) -> Uncertainty | None:
    """Error bars of the model of a scene between those of members: theirs, and by how much interpolation may be off.

    Errors of the odds are interpolated between the nearest two strengths. What interpolation is off by is taken from the
    distance to a polynomial of sqrt(xi) of one degree less.
    """
    held = [(member, member.uncertainty) for member in members if member.uncertainty is not None]
    if len(held) < len(members):
        return None
    known, strength = [member.calibration.strength or WEAKEST for member in members], scene.disorder.strength
    shares = nearest(strength, known)
    times = held[shares.index(max(shares))][1].times
    eye, here = torch.eye(model.n_bands, dtype=torch.float64), model.transfer(times).detach()
    variance, slopes, bases = torch.zeros_like(here), torch.zeros_like(eye), torch.zeros_like(eye)
    for weight, (member, errors) in zip(shares, held, strict=True):
        if weight:
            scale = _odds_slope(here) / _odds_slope(member.model.transfer(times).detach())
            variance += weight * (errors.of(eye, times) * scale).square()
            bases += (
                weight * (errors.basis_stderr * _odds_slope(model.basis) / _odds_slope(member.basis.detach())).square()
            )
            slopes += weight * errors.rates_stderr.square()
    spread = variance.sqrt()
    if strength not in known and sets > 1:
        lower = between(members, scene, sets - 1, 1).transfer(times).detach()
        spread = (variance + model_error(here, lower, spread, spread).square()).sqrt()
    return Uncertainty(slopes.sqrt(), bases.sqrt(), times, spread)


def _odds_slope(share: Tensor) -> Tensor:
    """By how much a share of the energy changes with the logarithm of its odds."""
    return (share * (1 - share)).clamp(min=1e-30)
