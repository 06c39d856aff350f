"""The compact model: never negative, conserving and exact at early times by form; recovery, chains, families."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.master import compact, compact_family, logistic, waves
from torchchain.master.certificate import CertificateError, certify
from torchchain.master.compact import CompactModel, n_coefficients
from torchchain.master.compact_family import calibrate_together
from torchchain.master.equation import MasterEquation
from torchchain.master.logistic import Regression, chosen_times, fit_compact, regression
from torchchain.master.misfit import model_error
from torchchain.master.proof import Certificate
from torchchain.master.report import Calibration, Report
from torchchain.master.waves import Waves, first_odds

B = 8
ZERO = torch.zeros(B, B, dtype=torch.float64)
DEGREES = (4, 3, 6)


def scene(strength=0.3, seed=0, realizations=60, stop=60.0):
    times = [*np.arange(0, 5, 0.25), *np.arange(5, stop + 0.1, 1.0)]
    return tc.Scene(
        n_particles=64, n_bands=B, realizations=realizations, seed=seed, times=times, disorder=tc.Disorder(strength=strength)
    )  # fmt: skip


@pytest.fixture(scope="module")
def transfers():
    return tuple(tc.band_transfer(scene(seed=seed), starts=False) for seed in (0, 1))


def model_of(coefficients, strength=0.3, degrees=DEGREES):
    found = Waves.of(scene(strength))
    return CompactModel(
        ZERO, torch.tensor(degrees, dtype=torch.float64), torch.as_tensor(coefficients, dtype=torch.float64), **found.tensors()
    )  # fmt: skip


def random_model(seed=0, size=1.0, **settings):
    count = n_coefficients(settings.get("degrees", DEGREES))
    return model_of(size * np.random.default_rng(seed).normal(size=count), **settings)


def distance(transfer):
    return tc.statistical_distance(transfer.stderr).mean(0)


def fitted(transfer, degrees=DEGREES, **settings):
    late = transfer.long_time
    return fit_compact(ZERO, Waves.of(transfer.scene), degrees, transfer.times, transfer.mean, late, distance(transfer), **settings)  # fmt: skip


# By form, whatever the coefficients


@pytest.mark.parametrize("size", [0.0, 1.0, 1e3])
def test_any_coefficients_make_shares_of_the_energy(size):
    model = random_model(size=size)
    times = torch.cat([torch.zeros(1), torch.logspace(-6, 6, 200), torch.tensor([math.inf])]).double()
    found = model.at(times)
    assert bool(found.isfinite().all())
    assert float(found.min()) >= 0
    assert float((found.sum(-1) - 1).abs().max()) <= model.certificate.conservation_defect
    assert torch.equal(found[:, 0], torch.eye(B, dtype=torch.float64))
    certificate = certify(model)
    assert certificate.holds
    assert certificate.lower == 0


def test_transfer_starts_as_the_fourth_power_of_time():
    model = random_model(size=0.3)
    times = torch.tensor([1e-5, 1e-4, 1e-3], dtype=torch.float64)
    off = ~torch.eye(B, dtype=torch.bool)
    moved = model.transfer(times).transpose(1, 2)[off]
    # the clock's square root of t turns by sqrt(t / t0) per degree between the two times
    power = (moved[:, 1] / moved[:, 0]).log10()
    assert bool((power > 3.9).all())
    assert bool((power < 4.1).all())


def test_first_odds_agree_with_perturbation_theory():
    """Without decay, one tone to another: xi^2 w w' ((1 - cos D t) / D^2 - (1 - cos S t) / S^2), D and S their difference and sum."""
    born = Waves.of(scene(0.01))
    still = Waves(born.source_frequency, born.source_decay * 0 + 1e-12, born.tone_frequency[:, :1], born.tone_decay[:, :1] * 0 + 1e-12, born.coupling)  # fmt: skip
    times = torch.tensor([0.02, 0.09999, 0.10001, 0.5, 1.0], dtype=torch.float64)
    found = first_odds(still, times, torch.arange(B))
    w, other = still.source_frequency[:, None, None], still.tone_frequency[:, 0]
    difference, total, t = w - other, w + other, times[:, None]
    exact = still.coupling * w * other * 2 * ((difference * t / 2).sin() ** 2 / difference**2 - (total * t / 2).sin() ** 2 / total**2)  # fmt: skip
    far = difference.abs().expand(exact.shape) > 0.1
    # the floor adds at most (FLOOR envelope / odds)^2 of them, the square of about FLOOR times two
    relative = (found / exact - 1).abs()
    assert (
        float(relative[far].max()) < 4 * waves.FLOOR**2 + 1e-4
    )  # cancellation at t = 0.02 leaves the series as the exact one


def test_series_and_closed_form_meet():
    medium = Waves.of(scene())
    edge = torch.tensor([waves.SERIES * (1 - 1e-9), waves.SERIES * (1 + 1e-9)], dtype=torch.float64)
    before, after = first_odds(medium, edge, torch.arange(B)).unbind(1)
    off = ~torch.eye(B, dtype=torch.bool)  # odds of the own band are not used
    assert float((after / before - 1).abs()[off].max()) < 1e-7  # t^4 itself changes by 8e-9


def test_born_decay_in_weak_disorder():
    frequency = 2 * np.sin(np.linspace(0.3, 2.2, 9) / 2)
    poles = waves.poles(frequency, 0.02)
    born = 0.02**2 * np.sin(np.linspace(0.3, 2.2, 9) / 2) * np.tan(np.linspace(0.3, 2.2, 9) / 2)
    np.testing.assert_allclose(-poles.imag, born, rtol=5e-3)


def test_sums_over_some_sources_are_those_over_all():
    model = random_model()
    start = torch.zeros(3, B, dtype=torch.float64)
    start[0, 2], start[1, 2], start[1, 5] = 1.0, 0.3, 2.0
    times = torch.tensor([0.5, 3.0, 80.0], dtype=torch.float64)
    whole = torch.einsum("ms,str->mtr", start, model.transfer(times))
    assert torch.allclose(model.propagate(start, times), whole, rtol=0, atol=1e-14)
    start.requires_grad_()
    model.propagate(start, times)[0, 1, 4].backward()
    assert bool(start.grad.isfinite().all())


def test_number_of_coefficients_does_not_depend_on_bands():
    assert n_coefficients((12, 8, 16)) == 498
    assert random_model().n_parameters == n_coefficients(DEGREES) == len(random_model().coefficients)


# Fits


def test_known_model_comes_back():
    truth = random_model(size=0.2)
    times = torch.cat([scene().times, torch.logspace(2, 6, 20).double()])  # beyond the data nothing is known
    mean = truth.transfer(times)
    error = torch.full_like(times, 1e-4)
    found, report = fit_compact(ZERO, Waves.of(scene()), DEGREES, times, mean, truth.basis, error)
    assert report["converged"]
    # the ridge pulls coefficients that data with weight w hardly tell: what is predicted is what must agree
    assert float(tc.total_variation(found.transfer(times), mean).max()) < 1e-3
    assert float(tc.total_variation(found.basis, truth.basis).max()) < 1e-3


def test_gradient_of_the_regression():
    truth = random_model(size=0.2)
    times = scene().times[1:12]
    problem = Regression.of(Waves.of(scene()), DEGREES, times, truth.transfer(times), np.linspace(1, 3, 11))
    at = 0.1 * np.random.default_rng(3).normal(size=int(problem.held.sum()))
    _, pull = problem.normal(problem.predicted(problem.table(at)), problem.table(at))
    along = np.random.default_rng(4).normal(size=len(at))
    ahead, behind = (problem.misfit(problem.table(at + step * along))[0] for step in (1e-5, -1e-5))
    assert (ahead - behind) / 2e-5 == pytest.approx(-2 * pull @ along, rel=1e-6)


def test_normal_equations_are_those_of_the_derivatives():
    """Of the shares by every coefficient, by finite differences; and of several right-hand sides at once."""
    draw = np.random.default_rng(5)
    for degrees in (DEGREES, (1, 1, 1), (3, 5, 2)):
        times = scene().times[1:40:8]
        truth = random_model(size=0.2).transfer(times)
        problem = Regression.of(Waves.of(scene()), degrees, times, truth, draw.uniform(1, 3, truth.shape[:2]))
        at = 0.1 * draw.normal(size=int(problem.held.sum()))
        steps = 1e-5 * np.eye(len(at))
        ahead, behind = ([problem.predicted(problem.table(at + sign * step)) for step in steps] for sign in (1, -1))
        slopes = (np.stack(ahead) - np.stack(behind)) / 2e-5 * problem.weight[..., None]
        found = problem.predicted(problem.table(at))
        matrix, pull = problem.normal(found, problem.table(at))
        expected = np.einsum("astr,bstr->ab", slopes, slopes) + logistic.RIDGE * np.eye(len(at))
        assert abs(matrix - expected).max() < 1e-8 * expected.max()
        missed = draw.normal(size=(2, *found.shape))
        expected = np.einsum("astr,nstr->na", slopes, missed * problem.weight[..., None])
        assert abs(problem.pull(found, missed) - expected).max() < 1e-8 * abs(expected).max()
        forced = problem.pull(found, problem.data - found) - logistic.RIDGE * at
        assert abs(pull - forced).max() < 1e-12 * abs(forced).max()


def test_normal_equations_of_tiny_shares():
    """Where next to nothing has left its band no digits are lost against what stays there."""
    times = torch.tensor([1e-2, 2e-2], dtype=torch.float64)
    model = random_model(size=0.2)
    problem = Regression.of(Waves.of(scene()), DEGREES, times, model.transfer(times), np.full((B, 2), 1e10))
    table = problem.table(0.1 * np.random.default_rng(6).normal(size=int(problem.held.sum())))
    found = problem.predicted(table)
    matrix, _ = problem.normal(found, table)
    away = problem.shape - problem.shape[range(B), range(B)][:, None]  # 0 where most is
    slope = away[:, None] - np.einsum("str,srp->stp", found, away)[:, :, None]
    slope = np.einsum("strp,str,tk->strpk", slope, found, problem.clock)[..., problem.held] * 1e10
    expected = np.einsum("stra,strb->ab", slope, slope) + logistic.RIDGE * np.eye(len(matrix))
    assert float(found[0, 0, 1]) < 1e-9
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert (abs(matrix - expected) / scale).max() < 1e-10


def test_fresh_chains_are_predicted_at_early_and_late_times(transfers):
    own, fresh = transfers
    model, _ = fitted(own, (8, 6, 12))
    off = tc.total_variation(model.transfer(fresh.times), fresh.mean).mean(0)
    noise = distance(own)
    for first, last in ((0, 1), (1, 5), (5, 60)):
        inside = (fresh.times > first) & (fresh.times <= last)
        assert float(off[inside].mean()) < 1.25 * float(noise[inside].mean())


def test_weak_disorder_is_followed_from_the_first_moments_on():
    # energies of 1e-9 have an error of their own, far below that of late times: they are not to be fitted to the latter's
    times = [0, 0.1, 0.2, 0.5, 1, 2, 5, *range(10, 200, 10)]
    one = dataclasses.replace(scene(strength=0.05), times=times)
    transfer = tc.band_transfer(one, starts=False)
    master = tc.calibrate(transfer, model="compact", degrees=DEGREES, bootstrap=0)
    off = tc.total_variation(master.transfer(transfer.times).detach(), transfer.mean).mean(0)[1:]
    noise = tc.statistical_distance(transfer.stderr).mean(0)[1:]
    assert float(noise[0]) < 1e-6 * float(noise[-1])
    assert float((off / noise).max()) < 1


def test_a_step_of_gauss_and_newton_is_a_fit_to_other_data(transfers):
    own, _ = transfers
    model, _ = fitted(own)
    problem = regression(Waves.of(own.scene), DEGREES, own.times, own.mean, own.long_time, distance(own))
    moved = problem.data.copy()
    picked = chosen_times(own.times)
    moved[:, : len(picked)] += 0.05 * (own.block_mean[0][:, picked].numpy() - problem.data[:, : len(picked)])
    same, changed = logistic.stepped(
        [problem], np.ones((1, 1)), model.coefficients.numpy()[None], [np.stack([problem.data, moved])]
    )[:, 0]
    again = dataclasses.replace(problem, data=moved)
    found, _ = logistic.solve([again], np.ones((1, 1)), model.coefficients.numpy()[None])
    times = own.times
    exact = CompactModel(**{**model.tensors(), "coefficients": torch.from_numpy(found[0])}).transfer(times)
    step = (exact - model.transfer(times)).abs().max()
    same, changed = (
        CompactModel(**{**model.tensors(), "coefficients": torch.from_numpy(row)}) for row in (same, changed)
    )
    assert float((same.transfer(times) - model.transfer(times)).abs().max()) < 0.5 * float(step)
    assert float((changed.transfer(times) - exact).abs().max()) < 0.5 * float(step)


def test_a_start_that_is_far_off_is_given_up(transfers):
    problem = regression(
        Waves.of(transfers[0].scene), DEGREES, transfers[0].times, transfers[0].mean, transfers[0].long_time
    )
    best, told = logistic.solve([problem], np.ones((1, 1)))
    random = np.random.default_rng(0)
    for size in (3.0, 30.0, 300.0):  # exponents of hundreds are cut off, and no step changes anything
        start = size * random.normal(size=best.shape)
        _, report = logistic.solve([problem], np.ones((1, 1)), start)
        assert report["misfit"] < 1.05 * told["misfit"]
        assert report["converged"]


def test_fits_are_deterministic(transfers):
    own, _ = transfers
    assert torch.equal(fitted(own)[0].coefficients, fitted(own)[0].coefficients)


def test_chosen_times_are_few_sorted_and_include_the_last():
    times = torch.cat([torch.arange(0, 200, 0.25), torch.arange(200, 5000, 10.0)]).double()
    picked = chosen_times(times)
    assert len(picked) <= logistic.FIT_TIMES
    assert picked[-1] == len(times) - 1
    assert bool((picked.diff() > 0).all())
    assert float(times[picked[0]]) == 0.25
    assert chosen_times(times[:5]).tolist() == [1, 2, 3, 4]


# As a model with memory


def test_nearest_model_with_memory(transfers):
    model, _ = fitted(transfers[0])
    memory = model.as_memory(span=300.0)
    times = torch.linspace(0, 60, 61, dtype=torch.float64)
    assert certify(memory).holds
    assert float(tc.total_variation(memory.transfer(times), model.transfer(times)).mean()) < 0.01
    parts = model.embedding()
    assert parts.start.shape[0] == B


@pytest.mark.parametrize("lowest", [-5e-8, -1e-3])
def test_nearest_model_where_none_is_certified(transfers, monkeypatch, lowest):
    """The least negative one stands in if it is no lower than -1e-6; a model that is lower is no answer."""

    def refuse(model, times, mean):
        raise CertificateError("no", (model, Certificate(lowest, 1.0, 0.0, 1.0, 1)))

    monkeypatch.setattr(compact, "nonnegative", refuse)
    model, _ = fitted(transfers[0])
    if lowest < -1e-6:
        with pytest.raises(CertificateError):
            model.as_memory(order=(1, 2), span=60.0)
    else:
        assert model.as_memory(order=(1, 2), span=60.0).n_bands == B


# Families


def test_family_predicts_a_strength_between():
    own = [tc.band_transfer(scene(strength, realizations=60), starts=False) for strength in (0.2, 0.25, 0.35, 0.4)]
    unseen = tc.band_transfer(scene(0.3, seed=1, realizations=60), starts=False)
    family = tc.MasterFamily(calibrate_together(own, (0.5, 2.0), 0, (6, 4, 8), 3))
    assert family.n_parameters == 3 * n_coefficients((6, 4, 8))
    model = family.at(0.3).model
    assert certify(model).holds
    off = tc.total_variation(model.transfer(unseen.times), unseen.mean).mean()
    assert float(off) < 1.5 * float(distance(unseen).mean())
    for low, high in ((0, 1), (1, 5), (5, 60)):
        inside = (unseen.times > low) & (unseen.times <= high)
        off = tc.total_variation(model.transfer(unseen.times), unseen.mean)[:, inside].mean()
        assert float(off) < 1.25 * float(distance(unseen)[inside].mean())
    weak = family.at(1e-3).model.transfer(unseen.times)
    assert float((1 - weak.diagonal(dim1=0, dim2=2)).max()) < 1e-3  # hardly anything moves
    with pytest.raises(FieldError, match="strength must be at most 0.4"):
        family.at(0.5)


def test_a_family_keeps_what_the_theory_says_of_its_members(monkeypatch, tmp_path):
    fitted_now = []
    fitted = compact_family._fitted
    monkeypatch.setattr(compact_family, "_fitted", lambda *given: fitted_now.append(given[0]) or fitted(*given))
    own = [tc.band_transfer(scene(strength, realizations=20), starts=False) for strength in (0.2, 0.4)]
    family = tc.MasterFamily(calibrate_together(own, (0.5, 2.0), 4, DEGREES, 2))
    assert [each.disorder.strength for each in fitted_now] == [0.2, 0.4]
    family.save(tmp_path / "family.safetensors")
    again = tc.MasterFamily.load(tmp_path / "family.safetensors")
    for each in (family, again):
        for strength in (0.3, 0.31, 0.3):
            each.at(strength)
    assert [each.disorder.strength for each in fitted_now[2:]] == [0.3, 0.31, 0.3, 0.31]
    times = own[0].times
    for name in ("transfer", "standard_error"):
        one, two = (
            each.at(0.3).transfer(times) if name == "transfer" else each.at(0.3).uncertainty.stderr
            for each in (family, again)
        )
        assert torch.equal(one, two)


def test_a_member_of_old_files_without_the_theory_is_told_it_again(monkeypatch):
    members = []
    for strength in (0.2, 0.4):
        record = Calibration("logistic", "compact", (0.5, 2.0), scene(strength), Report())
        members.append(MasterEquation(random_model(strength=strength, size=0.1), record))
    guide = compact_family._guide(scene(0.2), DEGREES)
    told = compact_family.between(members, scene(0.3), 2)
    held = members[0].model
    members[0] = MasterEquation(CompactModel(**held.tensors() | {"guide": guide}), members[0].calibration)
    assert torch.equal(compact_family.between(members, scene(0.3), 2).coefficients, told.coefficients)
    with pytest.raises(FieldError, match="guide must have shape"):
        CompactModel(**held.tensors() | {"guide": guide[:-1]})


def test_a_family_is_small_and_near_at_unseen_strengths():
    """Five ensembles; at strengths that none has, the error bars hold what interpolation is off by."""
    times = [*np.arange(0, 5, 0.25), *np.arange(5, 50.1, 1.0)]

    def ensemble(strength, seed):
        disorder = tc.Disorder(strength=strength)
        return tc.band_transfer(
            tc.Scene(n_particles=128, n_bands=B, realizations=100, seed=seed, times=times, disorder=disorder),
            starts=False,
        )

    family = tc.calibrate_family([ensemble(strength, 0) for strength in (0.05, 0.1, 0.2, 0.3, 0.5)])
    assert family.n_parameters <= 1500
    eye = torch.eye(B, dtype=torch.float64)
    shares = []
    for strength in (0.02, 0.07, 0.14, 0.4):
        unseen, master = ensemble(strength, 1), family.at(strength)
        off = tc.total_variation(master.transfer(times), unseen.mean).mean(0) / distance(unseen)
        for low, high in ((0, 1), (1, 5), (5, 50)):  # measured 0.54 to 1.39, of which the ensemble itself is 0.7
            assert float(off[(unseen.times > low) & (unseen.times <= high)].mean()) < 1.5
        error = master.standard_error(eye, times).square() + unseen.stderr.square()
        inside = ((master.transfer(times) - unseen.mean).square() < error)[:, 1:]
        shares.append(float(inside.double().mean()))
    assert 0.6 < sum(shares) / len(shares) < 0.76
    assert 0.5 < min(shares) <= max(shares) < 0.85


# The model's own error


def test_own_band_error_is_not_averaged_away():
    shape = (6, 20, 6)
    generator = torch.Generator().manual_seed(3)
    stderr = torch.full(shape, 1e-4, dtype=torch.float64)
    mean = torch.zeros(shape, dtype=torch.float64)
    predicted = mean + 1e-4 * torch.randn(shape, generator=generator, dtype=torch.float64)
    predicted.diagonal(dim1=0, dim2=2)[...] += 0.01
    error = model_error(predicted, mean, stderr, stderr)
    own = torch.eye(6, dtype=torch.bool)[:, None].expand(shape)
    assert torch.allclose(error[own], torch.tensor(0.01, dtype=torch.float64), rtol=0.05)
    assert float(error[~own].max()) < 3e-4


def test_what_noise_explains_is_no_error_of_the_model():
    stderr = torch.full((5, 9, 5), 1e-3, dtype=torch.float64)
    mean = torch.zeros_like(stderr)
    assert float(model_error(mean + 0.9e-3, mean, stderr, stderr).max()) == 0
    torch.testing.assert_close(
        model_error(mean + 1e-3, mean, stderr, 0.6 * stderr), 0.8 * stderr
    )  # noise that was followed hides less
    with pytest.raises(FieldError, match="noise must have shape"):
        model_error(mean, mean, stderr, stderr[:2])


# Bad input


@pytest.mark.parametrize("degrees", [(3, 4), (0, 3, 4), (3, 4, 41), "abc", (3, 4, 5.5)])
def test_bad_degrees(degrees):
    with pytest.raises((FieldError, FieldTypeError), match="degrees must"):
        n_coefficients(degrees)


@pytest.mark.parametrize(("name", "value"), [("coefficients", torch.zeros(3)), ("coupling", torch.tensor(-1.0)), ("tone_decay", torch.zeros(B, 2)), ("source_frequency", torch.ones(B + 1))])  # fmt: skip
def test_bad_tensors(name, value):
    tensors = random_model().tensors()
    with pytest.raises(FieldError, match=f"{name} must"):
        CompactModel(**{**tensors, name: value.double()})
