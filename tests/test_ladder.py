"""The ladder of models: swing-in, selection, error bars, horizon, damping, energy fed in, families over disorder."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import torch
import xarray
from made import basis_matrix, conserving_rates

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble.plan import ARTIFACT
from torchchain.master import MasterFamily, PredictionWarning, calibrate_family, chapman_kolmogorov, implied_timescales
from torchchain.master.calibration import recipe
from torchchain.master.certificate import certify
from torchchain.master.model import equal_steps, flows
from torchchain.master.rates import SwingInModel
from torchchain.master.sample import Sample, loss_rates
from torchchain.master.selection import rungs

B = 4
EYE = torch.eye(B, dtype=torch.float64)
TIMES = np.arange(0, 40.01, 0.5)


def swing_in(rates, basis, delay, times=TIMES):
    """Resting energy released at 1 / delay, which moves with the rates from then on, by quadrature over the release."""

    def at(t):
        moved, _ = scipy.integrate.quad_vec(
            lambda s: np.exp(-s / delay) / delay * scipy.linalg.expm(rates * (t - s)), 0, t, epsabs=1e-13
        )
        return basis + (np.eye(B) - basis) @ (np.exp(-t / delay) * np.eye(B) + moved)

    return np.stack([at(t) for t in times], axis=1)


def transfer_of(mean, long_time, times=TIMES, noise=0.0, blocks=20, seed=5, **scene):
    """A transfer of the given data [source, time, receiver], with noise of zero sum in every block."""
    mean = np.asarray(mean)
    shake = noise * np.random.default_rng(seed).normal(size=(blocks, *mean.shape))
    shake -= shake.mean(-1, keepdims=True)
    shake[:, :, 0] = 0
    each = torch.from_numpy(mean + shake)
    late = None if long_time is None else torch.from_numpy(np.asarray(long_time))
    scene = tc.Scene(n_particles=8 * B, n_bands=B, times=times, realizations=blocks, **scene)
    return tc.BandTransfer(
        scene, scene.times, each.mean(0), each.std(0) / blocks**0.5, late, None if late is None else torch.zeros_like(late),
        each, None if late is None else late.expand(blocks, B, B).clone(), (1,) * blocks, {"mass_mean": 1.0, "mass_sd": 0.3},
    )  # fmt: skip


# Swing-in


def test_swing_in_is_release_then_rates():
    model = SwingInModel(
        *map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))), torch.tensor(1.3, dtype=torch.float64)
    )
    times = torch.tensor([0.0, 0.1, 1.0, 7.0, 30.0], dtype=torch.float64)
    expected = swing_in(conserving_rates(B), basis_matrix(B), 1.3, times.numpy())
    np.testing.assert_allclose(model.transfer(times).detach().numpy(), expected, rtol=0, atol=1e-11)
    solved = tc.MasterEquation(model, None).solve(EYE, times, "dopri8").detach()
    np.testing.assert_allclose(solved.numpy(), expected, rtol=0, atol=1e-7)


def test_swing_in_starts_flat_conserves_and_stays_positive():
    model = SwingInModel(*map(torch.from_numpy, (conserving_rates(B), np.zeros((B, B)))), torch.tensor(2.0))
    early = model.transfer(torch.tensor([0.0, 1e-3, 2e-3], dtype=torch.float64)).detach()
    lost = 1 - early.diagonal(dim1=0, dim2=2)
    np.testing.assert_allclose((lost[2] / lost[1]).numpy(), 4, rtol=2e-3)  # t^2, not t
    later = model.transfer(torch.linspace(0, 300, 61, dtype=torch.float64)).detach()
    assert float((later.sum(-1) - 1).abs().max()) < 1e-12
    assert float(later.min()) >= 0


def test_late_energies_are_those_a_delay_earlier():
    rates, basis = map(torch.from_numpy, (conserving_rates(B, top=0.01), np.zeros((B, B))))
    delayed = SwingInModel(rates, basis, torch.tensor(2.0)).transfer(torch.tensor([52.0], dtype=torch.float64))
    plain = tc.RateModel(rates, basis).transfer(torch.tensor([50.0], dtype=torch.float64))
    assert float((delayed - plain).abs().max()) < 1e-3
    assert (
        float((plain - tc.RateModel(rates, basis).transfer(torch.tensor([52.0], dtype=torch.float64))).abs().max())
        > 5e-3
    )


@pytest.mark.parametrize("model", ["basis_matrix", "swing_in"])
def test_known_rates_are_recovered_without_noise(model):
    delay, times = 1.2, np.arange(0, 24.01, 1.0)
    mean = (
        swing_in(conserving_rates(B), basis_matrix(B), delay, times)
        if model == "swing_in"
        else tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))))
        .transfer(torch.from_numpy(times))
        .detach()
    )
    transfer = transfer_of(mean, basis_matrix(B), times)
    master = tc.calibrate(transfer, "adam", model, (1.0, 2.0), tolerance=0, steps=1500)
    np.testing.assert_allclose(master.rates.detach().numpy(), conserving_rates(B), rtol=0, atol=1e-4)
    if model == "swing_in":
        assert float(master.model.delay[0]) == pytest.approx(delay, abs=1e-2)
        assert master.model.n_parameters == 2 * B**2 + 1


@pytest.mark.parametrize("delay", [0.0, -1.0, math.nan, [1.0, 2.0]])
def test_bad_delays(delay):
    with pytest.raises((FieldError, FieldTypeError), match="delay must"):
        SwingInModel(EYE * 0, EYE, torch.as_tensor(delay, dtype=torch.float64))


# Known models come back within their error bars


def test_known_model_within_its_error_bars():
    truth = tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))))
    times = np.arange(0, 24.01, 1.0)
    exact = truth.transfer(torch.from_numpy(times)).detach()
    rates, energies = [], []
    for seed in range(3):
        data = transfer_of(exact.numpy(), basis_matrix(B), times, noise=0.01, seed=seed)
        master = tc.calibrate(data, "adam", "basis_matrix", (1.0, 2.0), bootstrap=10, steps=300)
        rates.append((master.rates.detach() - truth.rates.detach()).abs() < 3 * master.uncertainty.rates_stderr)
        found, error = master.solve(EYE, times).detach(), master.standard_error(EYE, times)
        energies.append(((found - exact).abs() < 3 * error)[:, 1:])
    assert float(torch.stack(rates).double().mean()) >= 0.95
    assert float(torch.stack(energies).double().mean()) >= 0.95


# Selection


def test_rungs_come_in_order_of_their_size(small_transfer):
    asked = recipe(small_transfer.scene)
    sizes = []
    for rung in rungs(asked, small_transfer):
        extra = {name: value for name, value in vars(rung.settings).items() if value}
        sizes.append(
            tc.calibrate(small_transfer, rung.fit.name, rung.model.name, bootstrap=0, **extra).model.n_parameters
        )
    plain = [size for size in sizes if size > small_transfer.n_bands**2]  # a diagonal basis is not counted by the model
    assert plain == sorted(plain)
    assert len(sizes) == len(rungs(asked, small_transfer)) >= 5


def test_the_smallest_model_that_fits_is_chosen():
    truth = tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))))
    mean = truth.transfer(torch.from_numpy(TIMES)).detach().numpy()
    coarse, fine = (
        tc.calibrate(transfer_of(mean, basis_matrix(B), noise=noise), bootstrap=0).calibration.report.selection
        for noise in (0.3, 0.003)
    )
    assert len(coarse.tried) < len(fine.tried)
    tried, halves = fine.tried, fine.halves_distance
    assert tried[-1].distance <= 1.05 * halves
    assert all(rung.distance > 1.05 * halves for rung in tried[:-1])


def test_too_few_blocks_hold_nothing_out():
    truth = tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))))
    mean = truth.transfer(torch.from_numpy(TIMES)).detach().numpy()
    master = tc.calibrate(transfer_of(mean, basis_matrix(B), noise=0.01, blocks=3))
    assert "too few blocks" in master.calibration.report.selection.reason
    assert master.uncertainty is None


@pytest.mark.parametrize("realizations", [1, 3])
@pytest.mark.parametrize(("n_particles", "chosen"), [(32, "compact"), (64, "theory")])
def test_a_few_chains_are_not_followed_with_thousands_of_numbers(n_particles, chosen, realizations):
    few, many = (
        tc.band_transfer(
            tc.Scene(
                n_particles=n_particles, n_bands=n_particles // 8, realizations=count, seed=seed, times=TIMES,
                disorder=tc.Disorder("binary", 0.9),
            ),
            starts=False,
        )
        for seed, count in ((0, realizations), (1, 100))
    )  # fmt: skip
    master = tc.calibrate(few)
    assert (master.calibration.model, master.n_parameters <= 53) == (chosen, True)
    assert "fewest fitted numbers: too few blocks" in master.calibration.report.selection.reason
    off, own = (tc.total_variation(found, many.mean)[:, 1:].mean() for found in (master.transfer(few.times), few.mean))
    assert float(off) < 0.9 * float(own)  # nearer to the ensemble than these chains are
    assert certify(master.model).holds
    assert realizations > 1 or master.horizon == TIMES[-1]  # one chain has no noise to be settled within


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_what_is_chosen_for_a_handful_of_chains_is_never_negative(seed):
    """Models of rates can be: -1e-3 of the energy with seed 0."""
    scene = tc.Scene(
        n_particles=32,
        n_bands=4,
        realizations=4,
        seed=seed,
        disorder=tc.Disorder(strength=0.05),
        times=np.arange(0, 60, 0.5),
    )
    master = tc.calibrate(tc.band_transfer(scene, starts=False), bootstrap=0)
    times = torch.cat([torch.zeros(1), torch.logspace(-2, 6, 100)]).double()
    assert float(master.transfer(times).detach().min()) > -1e-12
    assert master.calibration.report.certificate.holds


@pytest.mark.parametrize(("kind", "strength"), [("binary", 0.5), ("binary", 0.9), ("lognormal", 0.7), ("gamma", 0.9)])
def test_strong_disorder_of_other_kinds(kind, strength):
    """Fresh chains are missed by what two ensembles are apart, within the error bars, and nothing is ever negative."""
    times = np.concatenate([np.arange(0, 4, 0.5), np.arange(4, 41, 3)])
    disorder = tc.Disorder(kind, strength)
    scene = tc.Scene(n_particles=48, n_bands=6, realizations=80, disorder=disorder, times=times)
    own, fresh = (tc.band_transfer(replace(scene, seed=seed), method="modes", starts=False) for seed in (0, 1))
    master = tc.calibrate(own, bootstrap=8)
    assert "compact" in [rung.model for rung in master.calibration.report.selection.tried]
    assert master.calibration.report.certificate.holds
    late = torch.logspace(-2, 6, 60, dtype=torch.float64)
    assert float(master.model.transfer(late).min()) >= -1e-12
    found = master.model.transfer(own.times)
    if strength < 0.9 or kind != "binary":  # masses 19 times apart ring as no model here does
        off, noise = (tc.total_variation(each, fresh.mean)[:, 1:].mean() for each in (found, own.mean))
        assert float(off) < 1.25 * float(noise)
    error = master.standard_error(torch.eye(6, dtype=torch.float64), own.times).square() + fresh.stderr.square()
    assert 0.55 < float(((found - fresh.mean).square() <= error)[:, 1:].double().mean()) < 0.85


def test_what_is_near_at_all_times_is_not_left_for_a_model_that_nobody_looked_at_early():
    """Of models that look at each window of time none need do, yet they come before those that do not, if they are as near."""
    scene = tc.Scene(
        n_particles=64, n_bands=8, realizations=200, disorder=tc.Disorder(strength=0.0),
        stiffness_disorder=tc.Disorder(strength=0.3), times=np.concatenate([np.arange(0, 5, 0.25), np.arange(5, 60, 2.5)]),
    )  # fmt: skip
    master = tc.calibrate(tc.band_transfer(scene, starts=False), bootstrap=0)
    selection = master.calibration.report.selection
    assert min(rung.distance for rung in selection.tried) <= 1.05 * selection.halves_distance
    assert {rung.model for rung in selection.tried} <= {"theory", "corrected_theory"}
    assert master.n_parameters <= 80


def test_listed_times_choose_as_well_as_times_by_logarithm():
    """However its times are spaced, a model is chosen that is right early and late."""
    scene = tc.Scene(n_particles=48, n_bands=6, realizations=40)
    spaced = [torch.linspace(0, 500, 501), torch.cat([torch.zeros(1), torch.logspace(-1, math.log10(500), 60)])]
    seen = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 500.0], dtype=torch.float64)
    fresh = tc.band_transfer(replace(scene, seed=1, realizations=100, times=seen), method="modes", starts=False)
    for times in spaced:
        own = tc.band_transfer(replace(scene, times=times), method="modes", starts=False)
        off = tc.total_variation(tc.calibrate(own, bootstrap=0).model.transfer(seen), fresh.mean).mean(0)
        ensembles = tc.statistical_distance(fresh.stderr).mean(0) * math.sqrt(
            (1 + 100 / 40) / 2
        )  # of 40 and of 100 chains
        assert all(float(off[part].mean()) < 1.5 * float(ensembles[part].mean()) for part in (seen <= 8, seen > 8))


def test_coarse_times_are_no_reason_to_refuse():
    """The slopes in a window are a comparison for models without rates, and needed by those with rates alone."""
    scene = tc.Scene(n_particles=64, n_bands=8, realizations=20, times=[0.0, 5.0, 10.0, 20.0, 40.0, 80.0])
    transfer = tc.band_transfer(scene, method="modes", starts=False)
    for settings in ({}, {"model": "compact"}, {"model": "memory", "order": (1, 1)}):
        master = tc.calibrate(transfer, bootstrap=0, **settings)
        assert master.calibration.window == (0.0, 5.0)
    slopes = (transfer.mean[:, 1] - transfer.mean[:, 0]) / 5
    assert torch.allclose(master.rates, slopes, rtol=0, atol=1e-15)
    with pytest.raises(FieldError, match="window must hold at least 2 of the transfer's times"):
        tc.calibrate(transfer, model="paper", bootstrap=0)


# Error bars


def test_error_bars_of_a_start(small_transfer):
    master = tc.calibrate(small_transfer)
    times = small_transfer.times
    errors = master.standard_error(torch.eye(small_transfer.n_bands), times)
    assert errors.shape == small_transfer.mean.shape
    mixed = torch.rand(3, small_transfer.n_bands, dtype=torch.float64)
    apart = replace(master.uncertainty, alike=None)
    expected = torch.einsum("ms,str->mtr", mixed**2, errors**2).sqrt()
    assert torch.allclose(apart.of(mixed, times), expected, rtol=1e-12)
    shared = master.uncertainty.shared(times).numpy()  # of the bands' errors, v: what is shared adds up
    v = mixed.numpy()[:, :, None, None] * errors.numpy()
    square = (v**2 * (1 - (shared**2).sum(0))).sum(1) + sum((v * factor).sum(1) ** 2 for factor in shared)
    np.testing.assert_allclose(master.standard_error(mixed, times).numpy() ** 2, square, rtol=1e-6, atol=1e-30)
    beyond = master.standard_error(mixed, [float(times[-1]), 1e6])
    assert torch.equal(beyond[:, 0], beyond[:, 1])


def test_bootstrap_is_deterministic_and_saved(small_transfer, tmp_path):
    master, again = tc.calibrate(small_transfer), tc.calibrate(small_transfer)
    assert torch.equal(master.uncertainty.stderr, again.uncertainty.stderr)
    master.save(tmp_path / "q.safetensors")
    loaded = tc.MasterEquation.load(tmp_path / "q.safetensors")
    for name, value in master.uncertainty.tensors().items():
        assert torch.equal(value, loaded.uncertainty.tensors()[name])
    assert loaded.horizon == master.horizon


@pytest.mark.parametrize(
    ("count", "rule"), [(1, "be 0, or at least 2"), (-1, "at least 0"), (2.5, "an integer"), ("x", "an integer")]
)
def test_bad_bootstraps(count, rule, small_transfer):
    with pytest.raises((FieldError, FieldTypeError), match=f"bootstrap must.*{rule}"):
        tc.calibrate(small_transfer, bootstrap=count)


def test_no_error_bars_without_bootstrap(small_transfer):
    master = tc.calibrate(small_transfer, "linear", "paper", bootstrap=0)
    with pytest.raises(FieldError, match="bootstrap must be at least 2"):
        master.standard_error(torch.eye(small_transfer.n_bands), [1.0])


# Horizon and warnings


def test_predictions_beyond_the_horizon_warn(small_transfer):
    master = tc.calibrate(small_transfer, "linear", "paper")
    end = float(small_transfer.times[-1])
    assert master.horizon == end
    start = torch.eye(small_transfer.n_bands)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        master.solve(start, [0.0, end])
    with pytest.warns(PredictionWarning, match=f"to time {2 * end:g} lies beyond {end:g}"):
        master.solve(start, [0.0, 2 * end])


def test_a_settled_ensemble_has_no_horizon():
    truth = tc.RateModel(*map(torch.from_numpy, (conserving_rates(B, top=1.0), basis_matrix(B))))
    settled = truth.transfer(torch.tensor([1e4], dtype=torch.float64))[:, 0].detach().numpy()
    times = np.arange(0, 40.01, 0.5)
    mean = truth.transfer(torch.from_numpy(times)).detach().numpy()
    master = tc.calibrate(transfer_of(mean, settled, noise=0.003), order=(1, 1))
    assert master.horizon == math.inf


def test_negative_energies_warn():
    rates = torch.tensor([[-0.5, 0.5], [-0.1, 0.1]], dtype=torch.float64)
    master = tc.MasterEquation(tc.RateModel(rates, torch.zeros(2)), None)
    with pytest.warns(PredictionWarning, match="lowest predicted energy of a band is -"):
        master.solve([0.0, 1.0], [0.0, 1.0])


def test_what_a_scene_asks_beyond_the_calibration(small_transfer):
    master = tc.calibrate(small_transfer)
    scene = replace(small_transfer.scene, tolerance=0.1)
    assert master.concerns(scene) == []
    assert tc.plan(scene, master).method == ARTIFACT  # so that it is the changes that speak against the model
    changes = [
        ({"disorder": tc.Disorder(strength=0.2)}, "disorder 0.2, calibrated on 0.3"),
        ({"disorder": tc.Disorder("uniform", strength=0.3)}, "another kind of disorder"),
        ({"damping": 0.1}, "damping 0.1"),
        ({"times": [0.0, 1e9]}, "times to 1e\\+09" if math.isfinite(master.horizon) else ""),
        ({"disorder": tc.Disorder(strength=0.3, lower=0.6)}, "disorder lower 0.6, calibrated on 0.05"),
        ({"energy_definition": "bond"}, "energy_definition bond, calibrated on site"),
        ({"excitation": tc.StandingWave(tones=(1,))}, "tone 1 of 32 particles, no tone of the calibration"),
        ({"excitation": tc.Impulse()}, "an impulse, calibrated on standing waves"),
        ({"n_particles": 40}, "tone \\d of 40 particles, no tone of the calibration"),
    ]
    for change, message in changes:
        other = replace(scene, **change)
        found = master.concerns(other)
        if "calibrated" in message or "tone" in message:  # nor does the plan put it in the place of such chains
            assert tc.plan(other, master).method != ARTIFACT
        assert not message or any(__import__("re").search(message, text) for text in found), found


def test_bands_can_be_joined_but_not_split(small_transfer):
    master = tc.calibrate(small_transfer, "projection", order=(1, 1), bootstrap=0)
    half = small_transfer.n_bands // 2
    joined = master.coarsened(half)
    times = small_transfer.times
    fine = master.model.transfer(times).unflatten(0, (half, 2)).mean(1).unflatten(-1, (half, 2)).sum(-1)
    assert torch.allclose(joined.model.transfer(times), fine, rtol=0, atol=1e-13)
    assert joined.conservation_defect < 1e-12
    assert joined.calibration.scene.n_bands == half
    for count in (0, small_transfer.n_bands * 2, half + 1):
        with pytest.raises(FieldError, match="n_bands must"):
            master.coarsened(count)
    with pytest.raises(FieldError, match="model must be 'memory'"):
        tc.calibrate(small_transfer, "linear", "paper").coarsened(half)


# Energy fed in over time


@pytest.mark.parametrize("method", ["expm", "dopri8", "rk4"])
@pytest.mark.parametrize("grid", [[0.0, 1.0, 2.0, 3.0], [0.5, 2.0, 2.25]])
def test_constant_supply(method, grid):
    rates, basis = conserving_rates(B), basis_matrix(B)
    master = tc.MasterEquation(tc.RateModel(*map(torch.from_numpy, (rates, basis))), None)
    supply = np.array([0.3, 0.0, 0.1, 0.0])
    options = {"step": 0.01} if method == "rk4" else {}
    found = master.solve(np.zeros(B), grid, method, supply=supply, **options).detach().numpy()
    for i, t in enumerate(grid):
        response, _ = scipy.integrate.quad_vec(
            lambda s: supply @ (basis + (np.eye(B) - basis) @ scipy.linalg.expm(rates * s)), 0, t, epsabs=1e-13
        )
        np.testing.assert_allclose(found[i], response, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.sum(-1), 0.4 * np.array(grid), rtol=1e-8)


def test_supply_in_steps_is_the_sum_of_its_steps():
    master = tc.MasterEquation(tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B)))), None)
    times = [1.0, 2.0, 4.0]
    steps = torch.rand(2, 3, B, dtype=torch.float64)
    start = torch.rand(2, B, dtype=torch.float64)
    whole = master.solve(start, times, supply=steps).detach()
    parts = master.solve(start, times).detach()
    for i in range(3):
        only = torch.zeros_like(steps)
        only[:, i] = steps[:, i]
        parts = parts + master.solve(torch.zeros(2, B), times, supply=only).detach()
    assert torch.allclose(whole, parts, rtol=0, atol=1e-13)
    assert torch.allclose(
        whole.sum(-1), start.sum(-1)[:, None] + (steps.sum(-1) * torch.tensor([1.0, 1.0, 2.0])).cumsum(-1)
    )


@pytest.mark.parametrize("supply", [1.0, [1.0], np.zeros((2, B)), np.zeros((5, 3, B)), [math.nan] * B])
def test_bad_supplies(supply):
    master = tc.MasterEquation(tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B)))), None)
    with pytest.raises((FieldError, FieldTypeError), match="supply must"):
        master.solve(torch.zeros(2, B), [1.0, 2.0, 3.0], supply=supply)


# Damping


def damped_data(damping, rates, basis):
    model = tc.RateModel(*map(torch.from_numpy, (rates, basis, damping)))
    return model.transfer(torch.from_numpy(np.arange(0, 20.01, 0.05))).detach().numpy(), np.arange(0, 20.01, 0.05)


def test_damping_is_recovered_from_the_loss():
    damping = np.array([0.01, 0.03, 0.05, 0.2])
    mean, times = damped_data(damping, conserving_rates(B), basis_matrix(B) * 0)
    sample = Sample(torch.from_numpy(times), torch.from_numpy(mean), None, 0.3, True)
    np.testing.assert_allclose(loss_rates(sample).numpy(), damping, rtol=2e-3)  # the trapezoidal rule's error


@pytest.mark.parametrize("model", ["paper", "memory"])
def test_dissipated_energy_is_accounted_for(model):
    damping = np.array([0.02, 0.03, 0.05, 0.1])
    mean, times = damped_data(damping, conserving_rates(B), basis_matrix(B) * 0)
    transfer = transfer_of(mean[:, ::10], None, times[::10], noise=1e-4, damping=0.1)
    master = tc.calibrate(
        transfer,
        "projection" if model == "memory" else "linear",
        model,
        **({"order": (2, 1)} if model == "memory" else {}),
    )
    grid = times[::10]
    lost = master.dissipated(EYE, grid).detach()
    assert torch.allclose(lost + master.solve(EYE, grid).detach().sum(-1), torch.ones_like(lost), rtol=0, atol=1e-12)
    if model == "memory":  # Psi of Eq. 47 would keep energy where it started
        assert np.abs(lost.numpy() - (1 - mean[:, ::10].sum(-1))).max() < 0.01
    np.testing.assert_allclose(master.damping.numpy(), damping, rtol=0.1, atol=3e-3)


def test_damped_chains_end_to_end():
    scene = tc.Scene(
        n_particles=32,
        n_bands=4,
        realizations=8,
        times=np.arange(0, 20.01, 0.5),
        damping=0.1,
        disorder=tc.Disorder(strength=0.2),
    )
    transfer = tc.band_transfer(scene, "verlet", options={"step": 0.02})
    assert transfer.long_time is None
    energy = transfer.mean.sum(-1)
    assert torch.allclose(energy[:, 0], torch.ones(4, dtype=torch.float64), atol=1e-12)
    assert bool((energy.diff(dim=1) < 0).all())
    exact = tc.band_transfer(scene, "damped")  # the quadratic eigenvalue problem, no steps
    assert float((exact.mean - transfer.mean).abs().max()) < 1e-3
    master = tc.calibrate(transfer)
    assert float((master.dissipated(EYE, scene.times).detach() - (1 - energy)).abs().max()) < 0.02
    assert bool((master.damping.diff() > 0).all())  # relative velocities grow with the wavenumber


# Flows on any grid


def test_flows_on_an_uneven_grid():
    times = torch.cat([torch.arange(0, 5, 0.25), torch.arange(5, 25, 0.5), torch.tensor([25.1, 31.0, 99.0])]).double()
    assert [count for _, count in equal_steps(times)] == [20, 39, 1, 1, 1]
    rates = conserving_rates(B)
    expected = np.stack([scipy.linalg.expm(rates * t) for t in times.numpy()], axis=1)
    np.testing.assert_allclose(flows(EYE, torch.from_numpy(rates), times).numpy(), expected, rtol=0, atol=1e-13)


# Markov tests


def markov_transfer(noise):
    truth = tc.RateModel(torch.from_numpy(conserving_rates(B)), torch.zeros(B))
    mean = truth.transfer(torch.from_numpy(TIMES)).detach().numpy()
    return transfer_of(mean, np.full((B, B), 1 / B), noise=noise)


def test_markovian_data_pass_chapman_kolmogorov():
    exact = chapman_kolmogorov(markov_transfer(0.0), 2.0, (1, 2, 5))
    assert float(exact.distance.max()) < 1e-12
    noisy = chapman_kolmogorov(markov_transfer(0.01), 2.0, (2, 5))
    assert float((noisy.distance / noisy.statistical).mean()) < 1.5
    assert torch.equal(noisy.times, torch.tensor([4.0, 10.0], dtype=torch.float64))


def test_energy_that_stays_fails_chapman_kolmogorov():
    truth = tc.RateModel(*map(torch.from_numpy, (conserving_rates(B), basis_matrix(B))))
    mean = truth.transfer(torch.from_numpy(TIMES)).detach().numpy()
    result = chapman_kolmogorov(transfer_of(mean, basis_matrix(B), noise=0.001), 5.0, (4,))
    assert float((result.distance / result.statistical).mean()) > 5


def test_implied_timescales_of_known_rates():
    exact = np.sort(-1 / np.linalg.eigvals(conserving_rates(B)).real)
    exact = np.sort(exact[np.abs(exact) < 1e6])[::-1]
    scales, error = implied_timescales(markov_transfer(1e-5), [1.0, 5.0, 10.0])
    assert scales.shape == error.shape == (3, B - 1)
    np.testing.assert_allclose(scales.numpy(), np.broadcast_to(exact, (3, B - 1)), rtol=5e-3)
    assert bool((error > 0).all())


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda t: chapman_kolmogorov(t, 0.3), "lag must lead to times of the transfer"),
        (lambda t: chapman_kolmogorov(t, 0.0), "lag must be greater than 0"),
        (lambda t: chapman_kolmogorov(t, 2.0, (2, 1)), "multiples must be increasing"),
        (lambda t: chapman_kolmogorov(t, 2.0, (100,)), "multiples must lead to times"),
        (lambda t: implied_timescales(t, [0.0, 1.0]), "lags must be above 0"),
        (lambda t: implied_timescales(t, [0.3]), "lags must lead to times"),
    ],
)
def test_markov_tests_refuse(call, message):
    with pytest.raises(FieldError, match=message):
        call(markov_transfer(0.0))


# Families


@pytest.fixture(scope="module")
def strengths():
    transfers = []
    for strength in (0.1, 0.2, 0.3, 0.4):
        scene = tc.Scene(
            n_particles=64,
            n_bands=4,
            realizations=24,
            times=np.arange(0, 30.01, 0.5),
            disorder=tc.Disorder(strength=strength),
        )
        transfers.append(tc.band_transfer(scene))
    return transfers


@pytest.fixture(scope="module")
def family(strengths):
    return calibrate_family(strengths, degrees=(4, 3, 6))


@pytest.fixture(scope="module")
def with_memory(strengths):
    return calibrate_family(strengths, order=(1, 1))


def test_weights_of_a_family(family, with_memory):
    for each in (family, with_memory):
        assert each.strengths == (0.1, 0.2, 0.3, 0.4)
        for strength in np.linspace(0, 0.4, 41):
            assert sum(each.weights(strength).values()) == pytest.approx(1, abs=1e-12)
        assert each.weights(0.3) == {0.3: 1.0}
    assert with_memory.weights(0.05) == pytest.approx({0.0: 0.75, 0.1: 0.25})
    assert family.weights(0.05) == pytest.approx({0.1: 1.0, 0.2: 0.0, 0.3: 0.0, 0.4: 0.0}, abs=1e-12)


@pytest.mark.parametrize("strength", [0.0, 0.01, 0.05, 0.1, 0.17, 0.25, 0.39, 0.4])
def test_a_family_conserves_energy_at_any_strength(family, with_memory, strength):
    times = torch.linspace(0, 30, 16, dtype=torch.float64)
    for each in (family, with_memory):
        transfer = each.at(strength).model.transfer(times)
        assert float((transfer.sum(-1) - 1).abs().max()) < 1e-12
        assert torch.allclose(transfer[:, 0], torch.eye(4, dtype=torch.float64), atol=1e-12)
        assert each.at(strength).calibration.scene.disorder.strength == strength


@pytest.mark.parametrize("strength", [0.0, 0.01, 0.17, 0.4])
def test_a_family_is_never_negative_and_says_so(family, strength):
    late = torch.cat([torch.zeros(1), torch.logspace(-4, 6, 200)]).double()
    member = family.at(strength)
    assert member.calibration.report.certificate.holds
    assert float(member.model.transfer(late).min()) >= 0


def test_transfer_vanishes_with_the_square_of_the_strength(family, with_memory):
    # the odds of a compact model also depend on distance in units of the decay, which changes with the strength
    for each, times, error in ((with_memory, [10.0], 1e-9), (family, [1.0, 3.0], 0.05)):
        moved = [1 - each.solve(EYE, times, xi).diagonal(dim1=0, dim2=2) for xi in (0.02, 0.04)]
        np.testing.assert_allclose((moved[1] / moved[0]).numpy(), 4, rtol=error)
        assert torch.allclose(each.solve(EYE, times, 0.0)[:, 0], EYE, atol=1e-12)


def test_between_members_prediction_is_near_the_chains(family):
    scene = tc.Scene(
        n_particles=64,
        n_bands=4,
        realizations=100,
        times=np.arange(0, 30.01, 0.5),
        disorder=tc.Disorder(strength=0.25),
        seed=9,
    )
    chains = tc.band_transfer(scene, starts=False)
    distance = tc.total_variation(family.at(0.25).model.transfer(chains.times), chains.mean).mean()
    wrong = tc.total_variation(family.at(0.1).model.transfer(chains.times), chains.mean).mean()
    assert float(distance) < 0.03 < float(wrong) / 2
    (left, _), (right, _) = family.leave_one_out(chains.times)
    assert (left, right) == (0.2, 0.3)


def test_models_calibrated_alone_are_fitted_together(strengths):
    alone = [
        tc.calibrate(transfer, model="compact", degrees=degrees, bootstrap=4)
        for transfer, degrees in zip(strengths, [(4, 3, 6), (6, 4, 8)] * 2, strict=True)
    ]
    family = MasterFamily([*alone[:3], tc.calibrate(strengths[3], "projection", bootstrap=4)])
    assert {member.model.degrees_ for member in family.members} == {(6, 4, 8)}
    times = strengths[0].times
    for member, before in zip(family.members, alone, strict=True):
        apart = tc.total_variation(member.model.transfer(times), before.model.transfer(times)).mean()
        assert float(apart) < float(tc.statistical_distance(strengths[0].stderr).mean())
    assert family.at(0.25).uncertainty is not None


def test_a_family_is_one_file(family, tmp_path):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    family.save(first)
    MasterFamily.load(first).save(second)
    assert first.read_bytes() == second.read_bytes()
    with pytest.raises(FieldError, match="must carry the format torchchain-master-equation, got"):
        tc.MasterEquation.load(first)
    single = tmp_path / "one.safetensors"
    family.at(0.25).save(single)
    assert torch.equal(tc.MasterEquation.load(single).model.coefficients, family.at(0.25).model.coefficients)
    with pytest.raises(FieldError, match="must carry the format torchchain-master-family"):
        MasterFamily.load(single)
    first.write_bytes(first.read_bytes()[:-9])
    with pytest.raises(FieldError, match="must be a master equation saved by torchchain"):
        MasterFamily.load(first)


def test_families_refuse(family):
    with pytest.raises(FieldError, match="strength must be at most 0.4, the largest calibrated, got 0.5"):
        family.at(0.5)
    with pytest.raises(FieldError, match="members must have different strengths"):
        MasterFamily([family.members[0], family.members[0]])
    with pytest.raises(FieldError, match="members must be at least one"):
        MasterFamily([])
    plain = tc.MasterEquation(tc.RateModel(EYE * 0, EYE), family.members[0].calibration)
    with pytest.raises(FieldError, match="members must have the model 'compact' or 'memory'"):
        MasterFamily([plain])


def test_families_from_the_command_line(family, tmp_path, capsys):
    from torchchain.cli import main

    files = []
    for member in family.members:
        files.append(str(tmp_path / f"{member.calibration.scene.disorder.strength}.safetensors"))
        member.save(files[-1])
    out = tmp_path / "family"
    assert main(["family", *files, "--out", str(out)]) == 0
    assert "calibrated at 0.1, 0.2, 0.3, 0.4" in capsys.readouterr().out
    assert "left out and predicted by the others" in (out / "report.html").read_text(encoding="utf-8")
    model, predicted = str(out / "model.safetensors"), tmp_path / "predicted"
    with warnings.catch_warnings():
        warnings.simplefilter("error", PredictionWarning)
        assert main(["predict", model, "--strength", "0.25", "--out", str(predicted)]) == 0
    with xarray.open_dataset(predicted / "results.nc", engine="h5netcdf") as data:
        expected = family.solve(EYE, np.array(data.time), 0.25)
        assert np.array_equal(data.band_energy.values, expected.numpy())
        assert (data.band_energy_stderr.values >= 0).all()
    for wrong, message in (
        ([model], "must carry the format torchchain-master-equation"),
        ([model], "got torchchain-master-family, which takes a strength of the disorder (predict --strength"),
        ([model, "--strength", "0.5"], "strength must be at most 0.4"),
        ([files[0], "--strength", "0.1"], "must carry the format torchchain-master-family"),
    ):
        assert main(["predict", *wrong, "--out", str(tmp_path / "none")]) == 2
        assert message in capsys.readouterr().err
    assert main(["family", files[0], files[0], "--out", str(tmp_path / "none")]) == 2
    assert "different strengths" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()
