"""Energy that Hertz contacts carry between bands of frequency: closed form, invariants, recovery of known couplings."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import mixing

BANDS = mixing.FrequencyBands(6, 1.8)


def model(seed=0, bands=BANDS):
    draw = np.random.default_rng(seed)
    n = len(mixing.triads_of(bands)[0])
    return mixing.TriadModel(
        bands, torch.from_numpy(draw.uniform(0.05, 0.2, bands.n_bands)), torch.from_numpy(draw.uniform(0, 0.01, n))
    )


@pytest.fixture(scope="module")
def scene():
    return tc.Scene(n_particles=32, n_bands=4, realizations=12, times=torch.linspace(0, 40, 81))


@pytest.fixture(scope="module")
def measured(scene):
    bands = mixing.FrequencyBands.covering(scene.chain(range(8)), 5)
    return mixing.measure_mixing(scene, 0.12, bands, times=torch.linspace(0, 150, 13))


def test_second_harmonic_of_the_ordered_chain():
    """A traveling wave of amplitude A makes 2 (A^2 / 8) cot(k / 2) of tone 2 n, which beats (second-order perturbation theory)."""
    n, tone, amplitude = 128, 10, 0.02
    k = 2 * math.pi * tone / n
    phase = k * torch.arange(n, dtype=torch.float64)
    state = tc.State(amplitude * phase.cos(), 2 * amplitude * math.sin(k / 2) * phase.sin())
    beat = 4 * math.sin(k / 2) * (1 - math.cos(k / 2))
    chain = tc.Chain(torch.ones(n, dtype=torch.float64), contact="hertz")
    path = tc.evolve(chain, state, [math.pi / beat, 2 * math.pi / beat], method="symplectic4", step=0.05)
    forward = torch.fft.fft(path.displacement) - torch.fft.fft(path.velocity) / (2j * math.sin(k))
    found = forward[:, 2 * tone].abs() / n
    largest = amplitude**2 / 4 / math.tan(k / 2)
    assert float(found[0]) == pytest.approx(largest, rel=0.02)
    assert float(found[1]) < 0.02 * largest


def test_triads_resonate_and_lie_in_their_bands():
    triads, frequencies = mixing.triads_of(BANDS)
    torch.testing.assert_close(frequencies[:, 0] + frequencies[:, 1], frequencies[:, 2])
    assert torch.equal(BANDS.of(frequencies), triads)
    assert len({tuple(row) for row in triads.tolist()}) == len(triads)


@pytest.mark.parametrize("seed", range(5))
def test_energy_is_kept_and_entropy_grows(seed):
    made = model(seed)
    energy = torch.from_numpy(np.random.default_rng(seed + 100).exponential(0.01, (200, BANDS.n_bands)))
    slope = made.slope(energy)
    size = (made.coupling * made.flux(energy).abs()) @ made.exchange.abs()
    assert bool((slope.sum(-1).abs() <= 1e-13 * size.sum(-1)).all())
    gain = (slope * made.density / energy).sum(-1)
    assert bool((gain >= -1e-13 * (size * made.density / energy).sum(-1)).all())


def test_no_band_is_driven_below_zero():
    made = model()
    energy = torch.from_numpy(np.random.default_rng(3).exponential(0.01, (100, BANDS.n_bands)))
    for band in range(BANDS.n_bands):
        empty = energy.clone()
        empty[:, band] = 0
        assert bool((made.slope(empty)[:, band] >= 0).all())


def test_equal_energy_per_mode_is_a_fixed_point_that_is_reached():
    made = model()
    even = 0.02 * made.density / made.density.sum()
    assert float(made.slope(even).detach().abs().max()) < 1e-15
    start = torch.zeros(BANDS.n_bands, dtype=torch.float64)
    start[1] = 0.02
    end = made.solve(start, [0.0, 2e3]).detach()[-1]
    torch.testing.assert_close(end, even, rtol=1e-4, atol=0)


def test_solver_against_scipy():
    from scipy.integrate import solve_ivp

    made = model(1)
    start = torch.tensor([0.0, 0.02, 0.0, 0.01, 0.0, 0.0], dtype=torch.float64)
    times = torch.linspace(0, 5000, 6, dtype=torch.float64)
    found = made.solve(start, times, rtol=1e-9).detach()

    def slope(t, e):
        return made.slope(torch.from_numpy(e)).detach().numpy()

    known = solve_ivp(slope, (0, 5000), start.numpy(), t_eval=times.numpy(), rtol=1e-10, atol=1e-14).y.T
    np.testing.assert_allclose(found, known, rtol=1e-6, atol=1e-9)
    assert float(found.min()) >= 0
    torch.testing.assert_close(found.sum(-1), torch.full((6,), 0.03, dtype=torch.float64), rtol=1e-12, atol=0)


def test_known_couplings_are_recovered(measured):
    """From energies that triads themselves have made."""
    known = mixing.TriadModel(measured.bands, measured.density, model(bands=measured.bands).coupling.detach() * 0.2)
    times = torch.linspace(0, 150, 61, dtype=torch.float64)
    made = known.solve(measured.mean[:, 0], times).detach()
    data = dataclasses.replace(measured, times=times, energies=made.expand(4, *made.shape))
    fit = mixing.fit_triads(data, bootstrap=0)
    torch.testing.assert_close(fit.model.coupling, known.coupling, rtol=0.02, atol=2e-6)


def test_hertz_chains_are_predicted_and_linear_ones_stay(measured, scene):
    fit = mixing.fit_triads(measured, bootstrap=5)
    assert bool((fit.model.coupling >= 0).all())
    assert bool((fit.stderr >= 0).all())
    assert float(fit.stderr.max()) > 0
    share = torch.zeros(1, 5, dtype=torch.float64)
    share[0, 1], share[0, 2] = 0.3, 0.7
    other = dataclasses.replace(scene, seed=1)
    held = mixing.measure_mixing(other, 0.12, measured.bands, starts=share, times=torch.linspace(0, 300, 7))
    found, start = held.mean[0], held.mean[0, 0]
    linear = (start - found).abs().sum()
    triads = (fit.model.solve(start, held.times).detach() - found).abs().sum()
    assert float(triads) < float(linear) / 2
    chain = scene.chain(range(3))
    path = tc.evolve(chain, tc.standing_wave(chain, tone=3), [0.0, 500.0])
    energy = mixing.frequency_band_energy(chain, path, measured.bands)
    torch.testing.assert_close(energy[:, 0], energy[:, 1], rtol=0, atol=1e-12 * float(energy.sum(-1).max()))


def test_mixing_depends_on_seed_and_realization_alone(scene, measured):
    one = torch.eye(5, dtype=torch.float64)[1:2]
    few = dataclasses.replace(scene, realizations=3)
    a, b = (mixing.measure_mixing(s, 0.12, measured.bands, starts=one, times=[0.0, 5.0]) for s in (scene, few))
    torch.testing.assert_close(a.energies[:3], b.energies, rtol=1e-12, atol=1e-18)
    assert not torch.allclose(a.energies[0], a.energies[1])
    assert float(a.energies[:, 0, 0, 1].mean()) == pytest.approx(0.12**2)


def test_nonlinear_master_equation(tmp_path, scene, measured):
    linear = tc.calibrate(tc.band_transfer(scene), model="paper", method="linear", bootstrap=0)
    triads = mixing.fit_triads(measured, bootstrap=0).model
    both = mixing.NonlinearMasterEquation.of(linear, triads)
    start = torch.tensor([[0.0, 1.0, 0.0, 0.0], [0.5, 0.0, 0.0, 0.5]], dtype=torch.float64)
    times = [0.0, 10.0, 40.0]
    weak = both.solve(start, times, energy_per_particle=1e-12)
    torch.testing.assert_close(weak, linear.solve(start, times), rtol=0, atol=1e-8)
    strong = both.solve(start, times, energy_per_particle=0.02)
    torch.testing.assert_close(strong.sum(-1), torch.ones(2, 3, dtype=torch.float64))
    assert not torch.allclose(strong, weak, atol=1e-3)
    both.save(tmp_path / "both.safetensors")
    again = mixing.NonlinearMasterEquation.load(tmp_path / "both.safetensors")
    assert torch.equal(again.solve(start, times, energy_per_particle=0.02), strong)
    assert [entry.name for entry in tmp_path.iterdir()] == ["both.safetensors"]
    linear.save(tmp_path / "linear.safetensors")
    for wrong in ("linear.safetensors", "none"):
        with pytest.raises(tc.FieldError, match=wrong):
            mixing.NonlinearMasterEquation.load(tmp_path / wrong)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (lambda s: mixing.measure_mixing(dataclasses.replace(s, damping=0.1), 0.1), "damping must be 0"),
        (lambda s: mixing.measure_mixing(s, -0.1), "amplitude must be"),
        (lambda s: mixing.measure_mixing(s, 0.1, starts=[[1.0, 1.0]], bands=mixing.FrequencyBands(2, 1.8)), "sum 1"),
        (lambda s: mixing.measure_mixing(s, 0.1, starts=[[1.0]]), "starts must have shape"),
        (lambda s: mixing.FrequencyBands(1), "n_bands must be"),
        (lambda s: mixing.FrequencyBands(4, 0.0), "top must be"),
        (lambda s: mixing.fit_triads(), "data must be at least one"),
        (lambda s: mixing.TriadModel(BANDS, torch.ones(6), torch.ones(3)), "coupling must have shape"),
        (lambda s: mixing.TriadModel(BANDS, torch.zeros(6), torch.ones(20)), "density must be positive"),
        (lambda s: model().solve(torch.ones(5), [1.0]), "initial must have 6 bands"),
        (lambda s: model().solve(-torch.ones(6), [1.0]), "initial must not be negative"),
        (lambda s: model().solve(torch.ones(6), [1.0], method="expm"), "method must be"),
    ],
)
def test_mistakes_are_named(scene, change, rule):
    with pytest.raises((tc.FieldError, tc.FieldTypeError), match=rule):
        change(scene)
