"""Couplings fitted through the solver to bands of wavenumber: planted ones recovered, against SciPy and the literal equations."""

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchchain as tc
from torchchain import mixing

TIMES = [0.0, 30.0, 90.0]
BANDS = mixing.FrequencyBands(4, 2.2)


@pytest.fixture(scope="module")
def linear():
    scene = tc.Scene(n_particles=32, n_bands=4, realizations=12, times=torch.linspace(0, 200, 401))
    return tc.calibrate(tc.band_transfer(scene, starts=False), model="paper", method="linear", bootstrap=0)


@pytest.fixture(scope="module")
def planted(linear):
    """The loss, whose model holds P, F and the modes in each band, and couplings to be found."""
    loss = mixing.TrajectoryLoss(linear, TIMES, torch.eye(4)[:, None].expand(-1, 3, -1), BANDS)
    coupling = np.random.default_rng(3).uniform(0, 0.06, loss.model.triads.n_parameters)
    return loss, coupling


def literal(planted, linear, start, times):
    """e_k(t) of one start by the formulas of the classes, triad by triad, integrated by SciPy."""
    loss, coupling = planted
    triads, density = loss.model.triads, loss.model.triads.density.numpy()
    spectrum, shapes = loss.model.spectrum.numpy(), loss.model.shapes.numpy()

    def slope(t, e):
        change = np.zeros(4)
        for g, (a, b, c), (wa, wb, wc) in zip(
            coupling, triads.triads.tolist(), triads.frequencies.tolist(), strict=True
        ):
            na, nb, nc = e[a] / density[a] / wa, e[b] / density[b] / wb, e[c] / density[c] / wc
            flux = g * (na * nb - nc * (na + nb))
            change[a] -= wa * flux
            change[b] -= wb * flux
            change[c] += wc * flux
        return change

    before = start @ spectrum
    later = solve_ivp(slope, (0, times[-1]), before, t_eval=times, rtol=1e-10, atol=1e-14).y.T
    kept = np.minimum(1, later / before)
    moved = linear.transfer(times).detach().numpy()
    stays = kept @ spectrum.T
    return np.einsum("s,ts,stk->tk", start, stays, moved) + (later - kept * before) @ shapes


@pytest.fixture(scope="module")
def fitted(linear, planted):
    starts = [a**2 * row for a in (0.1, 0.2) for row in np.eye(4)]
    energies = torch.from_numpy(np.stack([literal(planted, linear, start, TIMES) for start in starts]))
    return mixing.fit_trajectories(linear, TIMES, energies, BANDS, steps=40)


def test_planted_couplings_are_recovered_from_three_times(linear, planted, fitted):
    both, report = fitted
    start, times = np.array([0.01, 0.0, 0.02, 0.005]), [0.0, 15.0, 60.0, 150.0]
    wanted = literal(planted, linear, start, times) / start.sum()
    found = both.solve(start, times, energy_per_particle=1.0).detach().numpy() / start.sum()
    alone = linear.solve(start, times).detach().numpy() / start.sum()
    assert report.loss < 1 < report.first_loss  # root mean square 0.3 % of the energy
    assert np.abs(found - wanted).max() < 0.1 * np.abs(alone - wanted).max()
    strong = planted[1] > 0.02
    off = both.triads.coupling.detach().numpy() / planted[1] - 1
    assert np.median(np.abs(off[strong])) < 0.15


def test_energy_is_kept_and_nothing_is_negative(fitted):
    both, _ = fitted
    start = torch.rand(6, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    energy = both.triads.solve(start * 0.03, [0.0, 10.0, 100.0, 1e3]).detach()
    assert bool((both.triads.coupling >= 0).all())
    assert float(energy.min()) >= 0
    torch.testing.assert_close(energy.sum(-1), 0.03 * start.sum(-1, keepdim=True).expand(-1, 4), rtol=1e-12, atol=0)
    late = both.solve(start, [0.0, 10.0, 40.0], energy_per_particle=0.01).detach()
    torch.testing.assert_close(late.sum(-1), start.sum(-1, keepdim=True).expand(-1, 3), rtol=1e-12, atol=0)


def test_gradients_against_differences(linear, planted):
    loss = mixing.TrajectoryLoss(linear, [0.0, 40.0], torch.eye(4)[:, None].expand(-1, 2, -1), BANDS, rtol=1e-9)
    here = torch.from_numpy(planted[1]) / 100

    def value(shift):
        with torch.no_grad():
            loss.model.triads.coupling.copy_(here + shift)
        return loss()

    slope = torch.autograd.grad(value(0 * here), loss.model.triads.coupling)[0]
    for i in (0, len(here) // 2):
        step = torch.zeros_like(here)
        step[i] = 1e-6
        difference = float(value(step).detach() - value(-step).detach()) / 2e-6
        assert float(slope[i]) == pytest.approx(difference, rel=1e-4)


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"times": [1.0, 2.0]}, "times must be at least 2 from 0 on"),
        ({"energies": torch.ones(2, 3, 5)}, r"energies must have shape \(start, 3, 4\)"),
        ({"energies": torch.zeros(2, 3, 4)}, "energies must not be zero at time 0"),
        ({"stderr": torch.ones(2, 2, 4)}, "stderr must have shape"),
        ({"stderr": -torch.ones(2, 3, 4)}, "stderr must not be negative"),
        ({"steps": 0}, "steps must be"),
        ({"learning_rate": 0.0}, "learning_rate must be"),
    ],
)
def test_mistakes_are_named(linear, change, rule):
    given = {"times": TIMES, "energies": torch.ones(2, 3, 4), "bands": BANDS} | change
    with pytest.raises(tc.FieldError, match=rule):
        mixing.fit_trajectories(linear, **given)


def test_a_linear_model_without_a_scene_is_refused():
    bare = tc.MasterEquation(tc.RateModel(torch.zeros(4, 4), torch.ones(4)), None)
    with pytest.raises(tc.FieldError, match="linear must be calibrated on a scene"):
        mixing.fit_trajectories(bare, TIMES, torch.ones(2, 3, 4))
