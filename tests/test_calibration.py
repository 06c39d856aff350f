"""Calibration on data whose rates are known, and on an ensemble."""

import warnings

import numpy as np
import pytest
import scipy.linalg
import torch
from made import basis_matrix, conserving_rates

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.master import NonlinearReport, Report
from torchchain.master.fits import FitWarning, profile
from torchchain.master.memory import MemoryModel
from torchchain.master.report import Rung

B = 4
XI = 0.3
TIMES = np.arange(0, 30.01, 0.25)


def transfer_of(mean, times=TIMES, long_time=None, noise=0.0, disorder=None):
    """A transfer with the given data [source, time, receiver], of as many blocks of one realization as fits need."""
    blocks = np.repeat(np.asarray(mean)[None], 6, 0)
    blocks = blocks + noise * np.random.default_rng(2).normal(size=blocks.shape)
    tensor = torch.from_numpy
    scene = tc.Scene(
        n_particles=8 * B, n_bands=B, times=times, realizations=6, disorder=disorder or tc.Disorder("normal", XI)
    )
    late = None if long_time is None else tensor(np.asarray(long_time, dtype=float))
    return tc.BandTransfer(
        scene, scene.times, tensor(blocks.mean(0)), tensor(blocks.std(0) / 5**0.5), late,
        None if late is None else torch.zeros_like(late), tensor(blocks),
        None if late is None else late.expand(6, B, B).clone(), (1,) * 6, {"mass_mean": 1.0, "mass_sd": XI},
    )  # fmt: skip


def markov(rates, basis, times=TIMES):
    """Pi + (I - Pi) exp(Q t) by SciPy, [source, time, receiver]."""
    return np.stack([basis + (np.eye(B) - basis) @ scipy.linalg.expm(rates * t) for t in times], axis=1)


def psi():
    """Eq. 47 with B bands, written out."""
    return np.array([1 / B + (1 - 1 / B) * np.exp(-((XI * r / 2) ** 1.5)) for r in range(1, B + 1)])


def distance(master, transfer):
    predicted = master.solve(torch.eye(B, dtype=torch.float64), transfer.times).detach()
    return tc.total_variation(predicted, transfer.mean)


# The linear procedure


def test_linear_fit_of_straight_lines():
    rates, t0 = conserving_rates(B), 0.4
    mean = np.stack([np.eye(B) + (1 - psi())[:, None] * rates * (t - t0) for t in TIMES], axis=1)
    master = tc.calibrate(transfer_of(mean), "linear", "paper")
    np.testing.assert_allclose(master.rates.detach().numpy(), rates, rtol=0, atol=1e-12)
    np.testing.assert_allclose(master.basis.numpy(), np.diag(psi()), rtol=1e-14)
    assert master.conservation_defect < 1e-12
    assert master.calibration.window == (0.5, 2.0)
    assert (master.calibration.method, master.calibration.model) == ("linear", "paper")


@pytest.mark.parametrize("window", [(0.5, 2.0), (1.0, 2.0), (0.0, 30.0), (0.25, 0.5)])
def test_linear_fit_is_least_squares_in_the_window(window):
    mean = markov(conserving_rates(B), np.diag(psi()))
    inside = (window[0] <= TIMES) & (window[1] >= TIMES)
    master = tc.calibrate(transfer_of(mean), "linear", "paper", window)
    for s in range(B):
        for r in range(B):
            slope = np.polyfit(TIMES[inside], mean[s, inside, r], 1)[0] / (1 - psi()[s])
            assert master.rates[s, r].item() == pytest.approx(slope, abs=1e-12)
    assert master.calibration.window == window
    assert master.conservation_defect < 1e-13  # one window for all entries: linear in data that sum to 1


# Eq. 50


def test_profile_of_eq_50():
    shape = profile(B).numpy()
    for s in range(1, B + 1):
        for r in range(1, B + 1):
            if r != s:
                assert shape[s - 1, r - 1] == pytest.approx(np.sin(np.pi / (2 * B) * min(s, r)) ** 2, rel=1e-14)
    np.testing.assert_allclose(shape.sum(1), 0, atol=1e-15)


def test_analytic_fit_recovers_q0():
    q0 = 0.013
    mean = np.stack([np.eye(B) + (1 - psi())[:, None] * q0 * profile(B).numpy() * t for t in TIMES], axis=1)
    master = tc.calibrate(transfer_of(mean), "analytic", "paper")
    assert master.calibration.report.fit.q0 == pytest.approx(q0, rel=1e-12)
    assert master.calibration.report.fit.q0_stderr < 1e-14
    np.testing.assert_allclose(master.rates.detach().numpy(), q0 * profile(B).numpy(), rtol=1e-12, atol=1e-16)
    assert master.conservation_defect < 1e-15


# The nonlinear procedure


def exponentials(speed, t0=0.3):
    """Every source decays to 1 - y, every receiver rises to its share of y, all with the one speed."""
    y = np.array([0.2, 0.4, 0.5, 0.7])
    share = np.random.default_rng(0).dirichlet(np.ones(B - 1), B)
    end = np.zeros((B, B))
    end[~np.eye(B, dtype=bool)] = (y[:, None] * share).ravel()
    end -= np.diag(y)
    mean = np.stack([np.eye(B) + end * (1 - np.exp(-speed * (t - t0))) for t in TIMES], axis=1)
    return mean, end * speed


@pytest.mark.parametrize("speed", [0.1, 0.4, 1.5])
def test_nonlinear_fit_of_exponentials(speed):
    mean, slopes = exponentials(speed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        master = tc.calibrate(transfer_of(mean), "nonlinear", "paper")
    assert master.calibration.report == Report(fit=NonlinearReport(()), horizon=30.0)
    assert master.calibration.window == (0.5, 4.5)
    # The slope at t0, per free energy; the search stops at 1e-8 relative.
    np.testing.assert_allclose(master.rates.detach().numpy() * (1 - psi())[:, None], slopes, rtol=1e-5)


def test_nonlinear_fit_reports_where_it_does_not_converge():
    mean, slopes = exponentials(0.4)
    mean[1, :, 2] = 0.1  # flat: no speed
    mean[2, :, 3] = 0.02 * TIMES  # straight: no saturation
    mean[3, :, 0] = 0.01 * np.exp(0.3 * TIMES)  # speeding up: no saturation either
    with pytest.warns(FitWarning, match="did not converge for 3 of 16 pairs of bands"):
        master = tc.calibrate(transfer_of(mean), "nonlinear", "paper")
    assert sorted(master.calibration.report.fit.unconverged) == [(2, 3), (3, 4), (4, 1)]
    linear = tc.calibrate(transfer_of(mean), "linear", "paper", (0.5, 4.5)).rates
    expected = slopes / (1 - psi())[:, None]
    for s, r in np.ndindex(B, B):
        failed = (s + 1, r + 1) in master.calibration.report.fit.unconverged
        value = linear[s, r].item() if failed else expected[s, r]
        assert master.rates[s, r].item() == pytest.approx(value, rel=1e-5, abs=1e-12)


def test_nonlinear_fit_of_constants():
    mean = np.repeat(np.eye(B)[:, None], len(TIMES), 1)
    with pytest.warns(FitWarning, match="did not converge for 16 of 16"):
        master = tc.calibrate(transfer_of(mean), "nonlinear", "paper")
    assert not master.rates.any()


def test_rates_that_make_energy_grow_are_reported():
    growing = conserving_rates(B) + 0.02 * np.eye(B)
    mean = np.stack([np.eye(B) + (1 - psi())[:, None] * growing * t for t in TIMES], axis=1)
    with pytest.warns(FitWarning, match=r"rates fitted by 'linear' make energy grow as exp\(0.02 t\).*beyond t = 50"):
        tc.calibrate(transfer_of(mean), "linear", "paper")


# Adam


@pytest.mark.parametrize("constraint", ["exact", "penalty"])
@pytest.mark.parametrize("model", ["paper", "basis_matrix"])
def test_adam_recovers_known_rates(model, constraint):
    rates = conserving_rates(B)
    basis = np.diag(psi()) if model == "paper" else basis_matrix(B)
    transfer = transfer_of(markov(rates, basis), long_time=basis_matrix(B))
    with warnings.catch_warnings():  # without noise the loss has no floor to converge to
        warnings.simplefilter("ignore", FitWarning)
        master = tc.calibrate(transfer, "adam", model, constraint=constraint, steps=1000)
    assert master.calibration.report.fit.constraint == constraint
    # Psi leaves band 1 next to no free energy to tell its rates by: the penalty's valley is long there.
    slow = (model, constraint) == ("paper", "penalty")
    assert distance(master, transfer).mean().item() < (1e-3 if slow else 1e-6)
    if not slow:
        np.testing.assert_allclose(master.rates.detach().numpy(), rates, rtol=0, atol=1e-4 * abs(rates).max())


@pytest.mark.filterwarnings("ignore::torchchain.master.fits.FitWarning")
def test_adam_is_deterministic():
    transfer = transfer_of(markov(conserving_rates(B), np.diag(psi())), noise=0.01)
    torch.manual_seed(1)
    first = tc.calibrate(transfer, "adam", "paper", steps=60, tolerance=0.0)
    torch.manual_seed(2)
    second = tc.calibrate(transfer, "adam", "paper", steps=60, tolerance=0.0)
    assert torch.equal(first.rates, second.rates)
    assert first.calibration.report == second.calibration.report


@pytest.mark.filterwarnings("ignore::torchchain.master.fits.FitWarning")
def test_the_exact_constraint_holds_whatever_the_data():
    leaky = markov(conserving_rates(B), np.diag(psi())) * np.exp(-0.02 * TIMES)[:, None]  # loses energy
    leaky[0, :, 3] -= 0.05 * (1 - np.exp(-TIMES / 5))  # asks for a negative rate
    exact = tc.calibrate(transfer_of(leaky), "adam", "paper", steps=200, tolerance=1e-3)
    assert exact.conservation_defect < 1e-15
    assert exact.most_negative_rate == 0.0
    free = tc.calibrate(
        transfer_of(leaky), "adam", "paper", constraint="penalty", penalty=0.0, steps=200, tolerance=1e-3
    )
    assert free.conservation_defect > 0.01
    assert free.most_negative_rate < 0
    # More freedom fits better; more weight on conservation leaks less.
    assert free.calibration.report.fit.loss < exact.calibration.report.fit.loss
    defects = [free.conservation_defect]
    for penalty in (1.0, 1e3, 1e6):
        settings = {"constraint": "penalty", "penalty": penalty, "steps": 200, "tolerance": 1e-3}
        defects.append(tc.calibrate(transfer_of(leaky), "adam", "paper", **settings).conservation_defect)
    assert defects == sorted(defects, reverse=True)
    assert defects[-1] < 1e-3


def test_adam_warns_when_it_stops_early():
    transfer = transfer_of(markov(conserving_rates(B), np.diag(psi())))
    with pytest.warns(FitWarning, match="Adam did not converge in 5 steps"):
        master = tc.calibrate(transfer, "adam", "paper", steps=5)
    assert not master.calibration.report.fit.converged
    assert master.calibration.report.fit.steps == 5


def test_adam_never_ends_above_where_it_began():
    transfer = transfer_of(markov(conserving_rates(B), np.diag(psi())))
    with pytest.warns(FitWarning):
        wild = tc.calibrate(transfer, "adam", "paper", constraint="penalty", learning_rate=10.0, steps=20)
    assert wild.calibration.report.fit.loss <= wild.calibration.report.fit.first_loss
    assert bool(wild.rates.isfinite().all())


# The model with memory


def memory_data(times=TIMES):
    """One exponential and one pair, rows of the basis that sum to 1."""
    random = np.random.default_rng(5)
    basis = random.dirichlet(np.ones(B), B)
    slow, sine = (x - x.mean(1, keepdims=True) for x in 0.1 * random.normal(size=(2, B, B)))
    cosine = np.eye(B) - basis - slow
    t = times[None, :, None]
    mean = basis[:, None] + slow[:, None] * np.exp(-0.08 * t)
    mean = mean + np.exp(-0.3 * t) * (cosine[:, None] * np.cos(0.5 * t) + sine[:, None] * np.sin(0.5 * t))
    return basis, mean


def test_projection_recovers_rates_and_amplitudes():
    basis, mean = memory_data()
    master = tc.calibrate(transfer_of(mean, long_time=basis), order=(1, 1))
    assert (master.calibration.method, master.calibration.model) == ("projection", "memory")
    model = master.model
    assert isinstance(model, MemoryModel)
    fitted = [model.decay.item(), model.pair_decay.item(), model.pair_frequency.item()]
    np.testing.assert_allclose(fitted, [0.08, 0.3, 0.5], rtol=1e-3)
    assert master.calibration.report.fit.converged
    assert distance(master, transfer_of(mean)).max().item() < 1e-4
    later = np.arange(0, 300.0, 7)  # beyond the data
    expected = memory_data(later)[1]
    np.testing.assert_allclose(master.solve(np.eye(B), later).numpy(), expected, atol=1e-3)
    total = master.solve(np.eye(B), later).sum(-1)
    assert torch.allclose(total, torch.ones_like(total), atol=1e-12)


def test_projection_chooses_an_order():
    basis, mean = memory_data()
    transfer = transfer_of(mean, long_time=basis, noise=0.01)
    master = tc.calibrate(transfer)
    assert master.calibration.report.fit.order == (1, 1)
    assert master.calibration.report.selection.tried[1] == Rung(
        "memory", (1, 0), master.calibration.report.selection.tried[1].distance
    )
    again = tc.calibrate(transfer)
    assert torch.equal(again.model.amplitudes, master.model.amplitudes)


# What all have in common


def test_models_differ_in_what_stays(small_transfer):
    n, late = small_transfer.n_bands, small_transfer.long_time
    bases = {
        "paper": torch.diag(tc.basis_fraction(0.3, n)),
        "exact_psi": torch.diag(late.diagonal()),
        "basis_matrix": late,
    }
    for model, basis in bases.items():
        assert torch.equal(tc.calibrate(small_transfer, "linear", model).basis, basis)
    assert tc.calibrate(small_transfer, "linear").calibration.model == "basis_matrix"
    assert tc.calibrate(small_transfer, order=(1, 1)).calibration.model == "memory"


def test_richer_models_are_nearer_to_the_ensemble(small_transfer):
    eye = torch.eye(4, dtype=torch.float64)

    def error(*arguments, **settings):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FitWarning)
            master = tc.calibrate(small_transfer, *arguments, **settings)
        return tc.total_variation(master.solve(eye, small_transfer.times), small_transfer.mean).mean().item()

    linear, adam = error("linear", "paper"), error("adam", "paper", steps=300)
    matrix, memory = error("adam", "basis_matrix", steps=300), error()
    assert memory < matrix < adam < linear


@pytest.mark.parametrize(
    ("method", "model"), [(None, None), ("linear", "paper"), ("nonlinear", "paper"), ("adam", None)]
)
def test_without_disorder_nothing_moves(method, model):
    ordered = tc.Scene(n_particles=32, n_bands=4, disorder=tc.Disorder(strength=0.0), realizations=3, times=TIMES)
    master = tc.calibrate(tc.band_transfer(ordered, "modes"), method, model)
    shares = master.solve(np.eye(B), [0.0, 50.0, 1e6]).detach().numpy()
    np.testing.assert_array_equal(shares, np.eye(B)[:, None].repeat(3, 1))
    assert master.calibration.report == Report(ordered=True)


@pytest.mark.parametrize("strength", [1e-9, 1e-6, 1e-3])
@pytest.mark.parametrize(("method", "model"), [("linear", "paper"), ("linear", "basis_matrix"), ("adam", "paper")])
def test_hardly_any_disorder_moves_hardly_anything(strength, method, model):
    weak = tc.Scene(n_particles=32, n_bands=4, disorder=tc.Disorder(strength=strength), realizations=3, times=TIMES)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        master = tc.calibrate(tc.band_transfer(weak, "modes"), method, model)
    shares = master.solve(np.eye(B), [0.0, 1.0, 50.0]).detach().numpy()
    np.testing.assert_allclose(shares, np.eye(B)[:, None].repeat(3, 1), atol=max(1e-6, 100 * strength**1.5))


DATA = transfer_of(markov(conserving_rates(B), np.diag(psi())), long_time=np.diag(psi()))


@pytest.mark.parametrize(
    ("arguments", "settings", "error", "message"),
    [
        (("fit",), {}, FieldError, "method must be one of analytic, .*, got 'fit'"),
        ((3,), {}, FieldTypeError, "method must be a string"),
        (("linear", "psi"), {}, FieldError, "model must be one of paper, .*, got 'psi'"),
        (("linear", "memory"), {}, FieldError, "model must be one of paper, .* for method 'linear'"),
        (("projection", "paper"), {}, FieldError, "model must be one of memory for method 'projection'"),
        (("linear", "paper", 3), {}, FieldTypeError, "window must be two times, got 3"),
        (("linear", "paper", (1, 2, 3)), {}, FieldTypeError, "window must be two times"),
        (("linear", "paper", (2, 1)), {}, FieldError, "window must be greater than 2, got 1"),
        (("linear", "paper", (-1, 1)), {}, FieldError, "window must be at least 0"),
        (("linear", "paper", (1, float("nan"))), {}, FieldError, "window must be finite"),
        (("linear", "paper", ("a", 1)), {}, FieldTypeError, "window must be a number"),
        (("linear", "paper", (0.3, 0.4)), {}, FieldError, "window must hold at least 2 of the transfer's times, got 0"),
        (("linear", "paper", (0.3, 0.6)), {}, FieldError, "window must hold at least 2 of the transfer's times, got 1"),
        (
            ("nonlinear", "paper", (1, 1.5)),
            {},
            FieldError,
            "window must hold at least 4 of the transfer's times, got 3",
        ),
        (("linear",), {"penalty": 1}, FieldError, "settings of method 'linear' must have only the keys"),
        (("adam",), {"order": (1, 1)}, FieldError, "settings of method 'adam' must have only the keys"),
        (("adam",), {"constraint": "none"}, FieldError, "constraint must be one of exact, penalty"),
        (("adam",), {"penalty": -1}, FieldError, "penalty must be at least 0"),
        (("adam",), {"steps": 0}, FieldError, "steps must be at least 1"),
        (("adam",), {"steps": 1.5}, FieldTypeError, "steps must be an integer"),
        (("adam",), {"learning_rate": 0}, FieldError, "learning_rate must be greater than 0"),
        (("adam",), {"tolerance": 1}, FieldError, "tolerance must be less than 1"),
        (("projection",), {"order": (0, 1)}, FieldError, "order must be at least 1"),
        (("projection",), {"order": (1, -1)}, FieldError, "order must be at least 0"),
        (("projection",), {"order": (1.0, 1)}, FieldTypeError, "order must be an integer"),
        (("projection",), {"order": 3}, FieldTypeError, "order must be two integers, got 3"),
        (("projection",), {"order": (1,)}, FieldTypeError, "order must be two integers"),
        (("projection",), {"order": "12"}, FieldTypeError, "order must be two integers"),
        (("projection",), {"order": (17, 1)}, FieldError, "order must be at most 16"),
    ],
)
def test_bad_requests(arguments, settings, error, message):
    with pytest.raises(error, match=message):
        tc.calibrate(DATA, *arguments, **settings)


def test_no_more_functions_than_the_times_tell_apart():
    few = np.arange(0, 2.6, 0.5)
    short = transfer_of(markov(conserving_rates(B), np.diag(psi()), few), few, np.diag(psi()))
    with pytest.raises(FieldError, match=r"order must have at most 3 functions for 6 times, got \(2, 1\)"):
        tc.calibrate(short, order=(2, 1))
    assert tc.calibrate(short, order=(1, 1)).calibration.report.fit.order == (1, 1)


@pytest.mark.parametrize("model", ["exact_psi", "basis_matrix", "memory"])
def test_models_that_need_the_long_time_average(model):
    without = transfer_of(markov(conserving_rates(B), np.diag(psi())))
    with pytest.raises(FieldError, match="transfer must hold the long-time average for this model"):
        tc.calibrate(without, model=model)
