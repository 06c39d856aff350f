"""The master equation: its solution by every solver against SciPy, and what it conserves."""

from functools import partial

import numpy as np
import pytest
import scipy.linalg
import torch
from made import basis_matrix, conserving_rates

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.master import Calibration, IntegrationError
from torchchain.master.memory import MemoryModel
from torchchain.master.solving import STABILITY
from torchchain.odes import INTEGRATORS

FIXED = tuple(STABILITY)
ORDERS = {entry.name: entry.order for entry in INTEGRATORS.values() if entry.order and not entry.name.endswith("adams")}
ADAPTIVE = tuple(name for name in ORDERS if INTEGRATORS[name].adaptive)
B = 5
RANDOM = np.random.default_rng(0)
rates_of = partial(conserving_rates, top=0.4, least=0.0)


def master(rates, basis, damping=None, dtype=torch.float64):
    tensors = [None if x is None else torch.as_tensor(x, dtype=dtype) for x in (rates, basis, damping)]
    scene = tc.Scene(n_particles=4 * len(rates), n_bands=len(rates))
    return tc.MasterEquation(tc.RateModel(*tensors), Calibration("given", "given", None, scene))


def literal_solution(initial, times, rates, basis, damping):
    """e(t) = e(0) (Pi exp(-D t) + (I - Pi) exp((Q - D) t)) by scipy.linalg.expm, one time after the other."""
    basis = np.diag(basis) if np.ndim(basis) == 1 else basis
    eye, drain = np.eye(len(rates)), np.diag(damping)
    return np.stack(
        [initial @ (basis @ scipy.linalg.expm(-drain * t) + (eye - basis) @ scipy.linalg.expm((rates - drain) * t))
         for t in times]
    )  # fmt: skip


GRIDS = {
    "regular": np.arange(0, 60.1, 0.5),
    "late": np.arange(3, 40.0, 1.5),
    "irregular": np.array([0.0, 0.1, 0.35, 4.0, 4.1, 300.0]),
    "one": np.array([7.0]),
    "zero": np.array([0.0]),
    "two": np.array([1.0, 9.0]),
    "long": np.arange(0, 500.0, 0.25),
}


@pytest.mark.parametrize("damped", [False, True])
@pytest.mark.parametrize("basis", [np.zeros(B), np.linspace(0.1, 0.9, B), basis_matrix(B)], ids=["none", "psi", "pi"])
@pytest.mark.parametrize("grid", GRIDS)
def test_matrix_exponential(grid, basis, damped):
    rates, times = rates_of(B), GRIDS[grid]
    damping = np.linspace(0, 0.02, B) if damped else np.zeros(B)
    initial = np.array([0.1, 0.0, 0.5, 0.4, 0.0])
    solved = master(rates, basis, damping).solve(initial, times)
    assert solved.shape == (len(times), B)
    # Repeated squaring loses a few digits over 2000 times: 1e-13 per power of two.
    np.testing.assert_allclose(
        solved.detach().numpy(), literal_solution(initial, times, rates, basis, damping), rtol=0, atol=2e-12
    )


def test_the_literal_master_equation():
    # Eq. 48 element by element: e_s' = Q_ss f_s + sum_r Q_rs f_r of the free energy f = e - e0, and Eq. 51's -d_s e_s.
    rates, psi, damping = rates_of(B), np.linspace(0.1, 0.9, B), np.linspace(0, 0.02, B)
    initial = np.array([0.1, 0.0, 0.5, 0.4, 0.0])
    model = master(rates, psi, damping)
    h = 1e-4
    at = model.solve(initial, [2 - h, 2.0, 2 + h]).detach().numpy()
    slope = (at[2] - at[0]) / (2 * h)
    free = at[1] - initial * psi * np.exp(-damping * 2.0)
    expected = [sum(rates[r, s] * free[r] for r in range(B)) - damping[s] * at[1][s] for s in range(B)]
    np.testing.assert_allclose(slope, expected, atol=1e-8)  # h^2 and eps / h


def test_rows_are_sources():
    rates = np.array([[-0.3, 0.3], [0.0, 0.0]])  # from band 1 to band 2, and nothing back
    shares = master(rates, np.zeros(2)).solve(np.eye(2), [0.0, 2.0, 1e3]).detach().numpy()
    assert shares.shape == (2, 3, 2)
    np.testing.assert_allclose(shares[0, 1], [np.exp(-0.6), 1 - np.exp(-0.6)], rtol=1e-14)
    np.testing.assert_allclose(shares[0, 2], [0, 1], atol=1e-14)
    np.testing.assert_allclose(shares[1], [[0, 1]] * 3, atol=1e-15)


def test_any_initial_distribution():
    model = master(rates_of(B), basis_matrix(B))
    times = [0.0, 1.0, 30.0]
    unit = model.solve(torch.eye(B, dtype=torch.float64), times)
    initial = torch.from_numpy(RANDOM.normal(size=(2, 3, B)))  # any unit, any sign: the equation is linear
    solved = model.solve(initial, times)
    assert solved.shape == (2, 3, 3, B)
    assert torch.allclose(solved, torch.einsum("abs,str->abtr", initial, unit), rtol=0, atol=1e-13)
    assert torch.allclose(solved[..., 0, :], initial, rtol=0, atol=1e-14)
    assert model.solve(torch.zeros(0, B), times).shape == (0, 3, B)
    assert torch.equal(model.model.transfer(torch.tensor(times, dtype=torch.float64)), unit)
    assert torch.equal(model(initial, torch.tensor(times)), solved)
    assert model.solve([1, 0, 0, 0, 0], times).shape == (3, B)


@pytest.mark.parametrize("method", tc.SOLVERS)
def test_every_solver(method):
    rates, basis, damping = rates_of(B), basis_matrix(B), np.linspace(0, 0.02, B)
    model = master(rates, basis, damping)
    initial = np.eye(B)[:2]
    options = {"step": 0.02} if method in FIXED else {"rtol": 1e-5} if method == "adaptive_heun" else {}
    for times in ([0.0, 0.5, 2.0, 10.0], [3.0], [0.0], [4.0, 5.0]):
        solved = model.solve(initial, times, method, **options).detach().numpy()
        expected = np.stack([literal_solution(e, times, rates, basis, damping) for e in initial])
        if method in ORDERS and method in FIXED:  # (rate h)^p / (p + 1)! times rate t, with rate below 2
            p = ORDERS[method]
            allowed = 20 * (2 * 0.02) ** p
        elif method in FIXED:  # four-step Adams methods, started by lower orders
            allowed = 20 * (2 * 0.02) ** 2
        elif method in ADAPTIVE:
            allowed = 1e-8 if ORDERS[method] >= 5 else 2e-5  # a few dozen steps with rtol 1e-8, thousands with 1e-6
        else:
            allowed = {"expm": 1e-13, "scipy_solver": 1e-6}[method]
        np.testing.assert_allclose(solved, expected, rtol=0, atol=allowed)


@pytest.mark.parametrize("method", [name for name in FIXED if name in ORDERS])
def test_observed_order(method):
    model = master(rates_of(B), np.zeros(B))
    exact = model.solve(np.eye(B), [4.0])
    errors = [(model.solve(np.eye(B), [4.0], method, step=h) - exact).abs().max().item() for h in (0.4, 0.2, 0.1)]
    slopes = np.diff(np.log(errors)) / np.log(0.5)
    assert slopes[-1] == pytest.approx(ORDERS[method], abs=0.25)
    assert slopes[0] == pytest.approx(ORDERS[method], abs=0.5)


@pytest.mark.parametrize("method", [name for name in FIXED if name in ORDERS])
def test_stated_stability_limits(method):
    # The stability polynomial of an s-stage method of order s is exp's Taylor polynomial: |R(-z)| = 1 at the limit.
    limit, p = STABILITY[method], ORDERS[method]
    stages = np.array([(-limit) ** k / np.prod(np.arange(1, k + 1), initial=1.0) for k in range(p + 1)])
    assert abs(stages.sum()) == pytest.approx(1, abs=1e-8)


@pytest.mark.parametrize("method", [name for name in FIXED if name in ORDERS])
def test_a_step_beyond_stability_is_refused(method):
    rates = np.array([[-1.0, 1.0], [1.0, -1.0]])  # fastest rate 2
    model, limit = master(rates, np.zeros(2)), STABILITY[method] / 2
    decay = model.solve([1.0, 0.0], [0.0, 200.0], method, step=0.99 * limit)
    assert decay.abs().max().item() <= 1 + 1e-9
    with pytest.raises(FieldError, match=f"step must be at most .* for '{method}'.*fastest rate 2"):
        model.solve([1.0, 0.0], [0.0, 200.0], method, step=1.01 * limit)


@pytest.mark.parametrize("method", [name for name in FIXED if name in ORDERS])
def test_oscillations_that_decay_do_not_grow_by_the_steps_chosen(method):
    # Two bands that swing at w = 2 and decay slowly: by the Euler rule, every step makes them larger by (w step)^2 / 2.
    model = tc.MemoryModel(
        rates=torch.zeros(2, 2, dtype=torch.float64), basis=torch.full((2, 2), 0.5, dtype=torch.float64),
        decay=torch.zeros(0, dtype=torch.float64), pair_decay=torch.tensor([0.01], dtype=torch.float64),
        pair_frequency=torch.tensor([2.0], dtype=torch.float64),
        amplitudes=torch.tensor([[[0.5, -0.5], [-0.5, 0.5]], [[0.0, 0.0], [0.0, 0.0]]], dtype=torch.float64),
    )  # fmt: skip
    solved = tc.MasterEquation(model, None).solve([1.0, 0.0], np.linspace(0, 50, 101), method)
    assert 0 <= float(solved.min()) <= float(solved.max()) <= 1.02
    if method in ("euler", "midpoint", "heun2"):
        with pytest.raises(FieldError, match=f"step must keep oscillations that decay from growing by '{method}'"):
            tc.MasterEquation(model, None).solve([1.0, 0.0], [0.0, 3e3], method, step=0.5)


def test_the_worst_member_of_a_batch_sets_the_step():
    # 200 members that stand still must not dilute the error of one that moves.
    model = master(rates_of(B), np.zeros(B))
    stationary = scipy.linalg.null_space(rates_of(B).T)[:, 0]
    batch = np.tile(stationary, (201, 1))
    batch[7] = np.eye(B)[2]
    solved = model.solve(batch, [20.0], "dopri5", rtol=1e-6, atol=1e-9)[7]
    assert torch.allclose(solved, model.solve(batch[7], [20.0]), rtol=0, atol=2e-5)


@pytest.mark.parametrize("method", ["expm", "dopri8"])
def test_semigroup(method):
    # Without basis energy, going on from where one was is the same as going all the way.
    model = master(rates_of(B), np.zeros(B))
    initial = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
    there = model.solve(initial, [13.0], method).detach()
    halfway = model.solve(initial, [5.0], method).detach()[-1]
    assert torch.allclose(
        model.solve(halfway, [8.0], method), there, rtol=0, atol=1e-7 if method == "dopri8" else 1e-13
    )
    # and with it, in the enlarged state
    parts = master(rates_of(B), basis_matrix(B)).model.embedding()
    step = torch.linalg.matrix_exp(5 * parts.generator)
    rest = torch.linalg.matrix_exp(8 * parts.generator)
    whole = parts.start @ step @ rest @ parts.readout
    solved = master(rates_of(B), basis_matrix(B)).solve(np.eye(B), [13.0])[:, 0]
    assert torch.allclose(whole, solved, rtol=0, atol=1e-13)


def test_energy_is_conserved():
    model = master(rates_of(B), basis_matrix(B))
    energy = model.solve(np.eye(B), np.arange(0, 1000, 0.5)).sum(-1)
    assert torch.allclose(energy, torch.ones_like(energy), rtol=0, atol=1e-12)
    assert model.conservation_defect < 1e-15
    assert model.most_negative_rate == 0.0


def test_leaks_and_negative_rates_are_reported():
    rates = rates_of(B)
    rates[1, 1] += 0.03
    rates[2, 4] = -0.05
    model = master(rates, np.zeros(B))
    assert model.conservation_defect == pytest.approx(abs(rates.sum(1)).max(), rel=1e-14)
    assert model.most_negative_rate == -0.05


def test_energy_settles_where_rates_balance():
    rates, basis = rates_of(B), np.linspace(0.1, 0.9, B)
    stationary = np.abs(scipy.linalg.null_space(rates.T)[:, 0])
    stationary /= stationary.sum()
    late = master(rates, basis).solve(np.eye(B), [1e4])[:, 0].detach().numpy()
    np.testing.assert_allclose(late, np.diag(basis) + (1 - basis)[:, None] * stationary, atol=1e-12)


def test_damping_of_all_bands_alike():
    times = np.array([0.0, 1.0, 20.0])
    free, damped = (master(rates_of(B), basis_matrix(B), np.full(B, d)) for d in (0.0, 0.05))
    expected = free.solve(np.eye(B), times).detach().numpy() * np.exp(-0.05 * times)[:, None]
    np.testing.assert_allclose(damped.solve(np.eye(B), times).detach().numpy(), expected, rtol=1e-12)


def test_rates_are_trainable():
    model = master(rates_of(B), basis_matrix(B))
    (parameter,) = model.parameters()
    assert parameter is model.rates
    target = (1, 3)
    for times in ([5.0], [0.0, 2.5, 5.0], [0.0, 1.0, 5.0]):  # both ways to step, one time and many
        (gradient,) = torch.autograd.grad(model.solve(np.eye(B), times)[0, -1, 3], parameter)
        bumped = []
        for h in (1e-6, -1e-6):
            rates = rates_of(B)
            rates[target] += h
            bumped.append(master(rates, basis_matrix(B)).solve(np.eye(B), times)[0, -1, 3].item())
        assert gradient[target].item() == pytest.approx((bumped[0] - bumped[1]) / 2e-6, rel=1e-6)


def test_single_precision_and_mixed_inputs():
    model = master(rates_of(B), basis_matrix(B), dtype=torch.float32)
    solved = model.solve(np.eye(B), np.arange(0, 10, 0.5))
    assert solved.dtype == torch.float32
    double = master(rates_of(B), basis_matrix(B)).solve(np.eye(B), np.arange(0, 10, 0.5))
    assert torch.allclose(solved.double(), double, atol=1e-5)
    mixed = tc.RateModel(torch.zeros(2, 2), torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    assert mixed.basis.dtype == mixed.damping.dtype == torch.float32


def memory_model(damping=None):
    """Two exponentials and one pair in four bands, energy conserved."""
    n = 4
    random = np.random.default_rng(3)
    basis = basis_matrix(n)
    basis = basis / basis.sum(1, keepdims=True) * 0.5 + 0.5 / n  # rows of 1: all energy ends in the basis
    free = np.eye(n) - basis
    loose = random.normal(size=(2, n, n)) * 0.1
    loose -= loose.mean(-1, keepdims=True)  # rows of 0
    sine = random.normal(size=(n, n)) * 0.1
    sine -= sine.mean(-1, keepdims=True)
    amplitudes = np.stack([free - loose[0] - loose[1], loose[0], loose[1], sine])
    tensors = {
        "rates": np.zeros((n, n)), "basis": basis, "amplitudes": amplitudes,
        "decay": [0.5, 0.05], "pair_decay": [0.1], "pair_frequency": [0.7],
    }  # fmt: skip
    return MemoryModel(
        **{name: torch.as_tensor(x, dtype=torch.float64) for name, x in tensors.items()}, damping=damping
    )


@pytest.mark.parametrize("damped", [False, True])
def test_memory_model(damped):
    damping = torch.tensor([0.0, 0.01, 0.02, 0.03], dtype=torch.float64) if damped else None
    model = memory_model(damping)
    times = np.array([0.0, 0.3, 4.0, 50.0])
    a = model.amplitudes.numpy()
    d = np.zeros(4) if damping is None else damping.numpy()
    for solved in (
        model.transfer(torch.from_numpy(times)).numpy(),
        tc.MasterEquation(model, None).solve(np.eye(4), times, "dopri8").numpy(),
    ):
        for i, t in enumerate(times):
            expected = model.basis.numpy() + a[0] * np.exp(-0.5 * t) + a[1] * np.exp(-0.05 * t)
            expected = expected + np.exp(-0.1 * t) * (a[2] * np.cos(0.7 * t) + a[3] * np.sin(0.7 * t))
            np.testing.assert_allclose(solved[:, i], expected * np.exp(-d * t), rtol=0, atol=1e-8)
    parts = model.embedding()
    for i, t in enumerate(times):
        exponential = scipy.linalg.expm(parts.generator.numpy() * t)
        whole = parts.start.numpy() @ exponential @ parts.readout.numpy()
        np.testing.assert_allclose(model.transfer(torch.from_numpy(times))[:, i].numpy(), whole, rtol=0, atol=1e-13)
    if not damped:
        total = model.transfer(torch.from_numpy(times)).sum(-1)
        assert torch.allclose(total, torch.ones_like(total), atol=1e-14)


NAN = float("nan")
MODEL = master(rates_of(B), basis_matrix(B))
EXPLODING = master(np.diag(np.full(B, 1.0)), np.zeros(B))


@pytest.mark.parametrize(
    ("arguments", "options", "error", "message"),
    [
        (([1, 0], [1.0]), {}, FieldError, "initial must have 5 bands on its last axis"),
        ((1.0, [1.0]), {}, FieldError, "initial must have 5 bands"),
        (([], [1.0]), {}, FieldError, "initial must have 5 bands"),
        (("abc", [1.0]), {}, FieldTypeError, "initial must be real numbers"),
        (([True, 0, 0, 0, 0], [1.0]), {}, None, ""),
        (([1, 0, 0, 0, NAN], [1.0]), {}, FieldError, "initial must be finite, got nan at position 5"),
        (([1, 0, 0, 0, 1j], [1.0]), {}, FieldTypeError, "initial must be real numbers"),
        ((np.eye(B), []), {}, FieldError, "times must hold at least one time"),
        ((np.eye(B), [1, 1]), {}, FieldError, "times must increase strictly"),
        ((np.eye(B), [-1.0]), {}, FieldError, "times must not be negative"),
        ((np.eye(B), [NAN]), {}, FieldError, "times must be finite"),
        ((np.eye(B), 1.0), {}, FieldError, "times must be one-dimensional"),
        ((np.eye(B), [1.0], "rk5"), {}, FieldError, "method must be one of expm, .*, got 'rk5'"),
        ((np.eye(B), [1.0], None), {}, FieldTypeError, "method must be a string"),
        ((np.eye(B), [1.0]), {"rtol": 1e-3}, FieldError, r"options of solver 'expm' must have only the keys \(none\)"),
        ((np.eye(B), [1.0], "rk4"), {"rtol": 1e-3}, FieldError, "must have only the keys step, got 'rtol'"),
        ((np.eye(B), [1.0], "rk4"), {"step": 0}, FieldError, "step must be greater than 0"),
        ((np.eye(B), [1.0], "rk4"), {"step": "x"}, FieldTypeError, "step must be a number"),
        ((np.eye(B), [1.0], "rk4"), {"step": 1e-300}, FieldError, "times must take at most 1000000 steps of 1e-300"),
        ((np.eye(B), [1e9], "euler"), {}, FieldError, "times must take at most 1000000 steps .*expm has no steps"),
        ((np.eye(B), [1.0], "dopri5"), {"rtol": 0}, FieldError, "rtol must be at least 8.88178e-16"),
        ((np.eye(B), [1.0], "dopri5"), {"rtol": 1}, FieldError, "rtol must be less than 1"),
        ((np.eye(B), [1.0], "dopri5"), {"atol": NAN}, FieldError, "atol must be finite"),
        ((np.eye(B), [1.0], "scipy_solver"), {"solver": "x"}, FieldError, "solver must be one of RK45"),
        (
            (np.eye(B), [1.0], "dopri5"),
            {"rtol": 1e-300, "atol": 1e-300},
            FieldError,
            "rtol must be at least",
        ),
        (([1e308] * B, [1.0]), {}, None, ""),
        ((np.eye(B), [1e300]), {}, FieldError, "times must be at most .*, where rounding blurs these rates"),
    ],
)
def test_bad_requests(arguments, options, error, message):
    if error is None:  # unusual, but a finite right answer
        assert bool(MODEL.solve(*arguments, **options).isfinite().all())
        return
    with pytest.raises(error, match=message):
        MODEL.solve(*arguments, **options)


@pytest.mark.parametrize("method", ["expm", "dopri8", "rk4"])
def test_growth_beyond_all_numbers_is_an_error(method):
    with pytest.raises(IntegrationError, match=f"solver '{method}' must"):
        EXPLODING.solve(np.eye(B), [0.0, 1.0, 800.0], method)


def test_the_latest_time_of_the_matrix_exponential():
    rates = rates_of(B)
    latest = 1e9 / abs(rates).sum(1).max()
    stationary = np.abs(scipy.linalg.null_space(rates.T)[:, 0])
    late = master(rates, np.zeros(B)).solve(np.eye(B), [0.999 * latest])[:, 0].detach().numpy()
    np.testing.assert_allclose(late, np.tile(stationary / stationary.sum(), (B, 1)), atol=1e-6)
    with pytest.raises(FieldError, match="times must be at most"):
        master(rates, np.zeros(B)).solve(np.eye(B), [1.001 * latest])


def test_an_output_time_costs_no_accuracy():
    # The dense output of dopri8 between its steps is of order 4 only: steps end at the output times.
    model = master(rates_of(B), np.zeros(B))
    times = np.linspace(0, 30, 50)
    error = (model.solve(np.eye(B), times, "dopri8") - model.solve(np.eye(B), times)).abs().max().item()
    assert error < 1e-9


EYE = torch.eye(3, dtype=torch.float64)


@pytest.mark.parametrize(
    ("tensors", "error", "message"),
    [
        ((EYE[:2], EYE[0]), FieldError, r"rates must be a square matrix, got shape \(2, 3\)"),
        ((EYE[0], EYE[0]), FieldError, "rates must be a square matrix"),
        ((torch.zeros(0, 0), torch.zeros(0)), FieldError, "rates must be a square matrix"),
        ((NAN * EYE, EYE[0]), FieldError, "rates must be finite"),
        (("x", EYE[0]), FieldTypeError, "rates must be real"),
        ((EYE, EYE[0, :2]), FieldError, r"basis must have shape \(3, 3\) like the rates"),
        ((EYE, 1.1 * EYE), FieldError, "basis must have row sums of at most 1, got 1.1 at band 1"),
        ((EYE, EYE[0], -EYE[0]), FieldError, "damping must not be negative, got -1 at band 1"),
        ((EYE, EYE[0], EYE), FieldError, r"damping must have shape \(3,\) like the rates"),
        ((EYE, torch.zeros(3, dtype=torch.complex128)), FieldTypeError, "basis must be real"),
        ((torch.tensor(1.0), torch.tensor(1.0)), FieldError, "rates must be a square matrix"),
        ((EYE, torch.tensor(1.0)), FieldError, "basis must have shape"),
    ],
)
def test_bad_models(tensors, error, message):
    with pytest.raises(error, match=message):
        tc.RateModel(*tensors)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"decay": [-0.1, 0.05]}, "decay must not be negative"),
        ({"decay": [0.1]}, r"amplitudes must have shape \(3, 4, 4\)"),
        ({"pair_frequency": [0.1, 0.2]}, "amplitudes must have shape|pair"),
        ({"amplitudes": np.zeros((4, 4, 4))}, "amplitudes must add up to 1 - basis at time 0"),
        ({"pair_frequency": [NAN]}, "pair_frequency must be finite"),
        ({"decay": 0.1}, "decay must"),
        ({"basis": 2 * np.eye(4)}, "basis must have row sums of at most 1"),
        ({"rates": np.zeros((3, 3))}, r"basis must have shape \(3, 3\)"),
    ],
)
def test_bad_memory(changes, message):
    tensors = {**memory_model().tensors(), **{k: torch.as_tensor(v, dtype=torch.float64) for k, v in changes.items()}}
    with pytest.raises(FieldError, match=message):
        MemoryModel(**tensors)
