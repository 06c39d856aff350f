"""Hertz contacts: their small-amplitude limit, opening and closing, energy; and how linear a motion is."""

import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import torchchain as tc
from torchchain.chain.amplitude import (
    LinearityWarning,
    elongation_bound,
    elongation_estimate,
    force_deviation,
    linearity,
    warn_if_nonlinear,
)
from torchchain.evolvers import METHODS, energy_guard, symplectic
from torchchain.evolvers.compositions import VERLET
from torchchain.evolvers.energy_guard import EnergyDriftError

HERTZ = [name for name, entry in METHODS.items() if "hertz" in entry.contacts]
SYMPLECTIC = ["verlet", "symplectic4"]


def masses(n=24, batch=(), seed=1):
    generator = torch.Generator().manual_seed(seed)
    return 0.6 + 0.8 * torch.rand(*batch, n, generator=generator, dtype=torch.float64)


def time_grid(end, count):
    return torch.linspace(0, end, count + 1, dtype=torch.float64)


def initial_energy(chain, state):
    start = tc.Trajectory(torch.zeros(1), state.displacement[..., None, :], state.velocity[..., None, :])
    return tc.total_energy(chain, start)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_deviation_from_linear_contacts_grows_with_the_amplitude(boundary):
    """Relative to the motion, the first correction to the force is -e / 4 (Eq. 9): of first power in the amplitude."""
    hertz, linear = tc.Chain(masses(), boundary, contact="hertz"), tc.Chain(masses(), boundary)
    times, deviations = time_grid(10, 20), []
    for amplitude in (1e-3, 2e-3, 4e-3):
        start = tc.standing_wave(hertz, 5, amplitude)
        bent = tc.evolve(hertz, start, times, "symplectic4", step=0.05).displacement
        straight = tc.evolve(linear, start, times, "symplectic4", step=0.05).displacement
        deviations.append(((bent - straight).norm() / straight.norm()).item())
    assert 1e-4 < deviations[0] < 1e-2
    assert np.log2(deviations[1] / deviations[0]) == pytest.approx(1, abs=0.02)
    assert np.log2(deviations[2] / deviations[1]) == pytest.approx(1, abs=0.04)


def test_period_of_a_nonlinear_oscillator():
    """Two equal particles against each other on a ring, by quadrature of the energy integral."""
    amplitude = 0.6  # of the contacts' elongation: both change by it, one longer, one shorter
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), contact="hertz")

    def potential(e):
        return 2 / 3 * (0.4 * (np.maximum(1 - e, 0) ** 2.5 - 1) + e) + 2 / 3 * (0.4 * ((1 + e) ** 2.5 - 1) - e)

    # relative coordinate e with mass 1/2; e = amplitude sin(angle) takes out the root at the turning point
    angles, weights = np.polynomial.legendre.leggauss(200)
    angles, weights = np.pi / 4 * (angles + 1), np.pi / 4 * weights
    speed = np.sqrt(4 * (potential(amplitude) - potential(amplitude * np.sin(angles))))
    period = 4 * (weights * amplitude * np.cos(angles) / speed).sum()
    half = torch.tensor([amplitude / 2, -amplitude / 2], dtype=torch.float64)
    times = torch.tensor([period / 4, period / 2, period, 5 * period], dtype=torch.float64)
    found = tc.evolve(chain, tc.State(half, torch.zeros(2)), times, "symplectic4", step=0.02)
    assert (found.displacement[0]).abs().max() < 1e-7
    for i, sign in ((1, -1), (2, 1), (3, 1)):
        assert torch.allclose(found.displacement[i], sign * half, atol=1e-7)
        assert found.velocity[i].abs().max() < 1e-6


@pytest.mark.parametrize("name", SYMPLECTIC)
@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_energy_balance_while_contacts_open(name, boundary):
    chain = tc.Chain(masses(batch=(3,)), boundary, contact="hertz")
    start = tc.standing_wave(chain, [5, 9], 0.8)
    trajectory = tc.evolve(chain, start, time_grid(100, 50), name, step=0.01)
    assert (trajectory.openings[..., -1] > 0).all()
    energy, initial = tc.total_energy(chain, trajectory), initial_energy(chain, start)
    assert (energy / initial - 1).abs().max() < (1e-4 if name == "verlet" else 1e-6)
    assert (energy[..., 1:].mean(-1) / initial[..., 0] - 1).abs().max() < (5e-5 if name == "verlet" else 1e-6)


@pytest.mark.parametrize("name", HERTZ)
def test_small_amplitudes_open_nothing(name):
    chain = tc.Chain(masses(), contact="hertz")
    settings = {"rtol": 1e-4} if "rtol" in METHODS[name].options else {}
    trajectory = tc.evolve(chain, tc.standing_wave(chain, 5, 0.01), time_grid(0.5, 2), name, **settings)
    assert trajectory.openings.shape == (3,)
    assert (trajectory.openings == 0).all()
    assert not trajectory.openings.is_floating_point()


@pytest.mark.parametrize("name", HERTZ)
def test_openings_count_contacts_open_at_any_step_so_far(name):
    chain = tc.Chain(masses(), "fixed", contact="hertz")
    start = tc.standing_wave(chain, 7, 0.7)
    times = time_grid(6, 6)
    fine = time_grid(6, 1200)
    opened = chain.open_contacts(tc.evolve(chain, start, fine, "symplectic4").displacement)
    expected = torch.stack([opened[fine <= t].any(0).sum() for t in times])
    assert expected[0] == chain.open_contacts(start.displacement).sum()
    assert expected[-1] > expected[0]
    settings = (
        {"step": 0.02} if "step" in METHODS[name].options else {"rtol": 1e-4 if name == "adaptive_heun" else 1e-5}
    )
    counted = tc.evolve(chain, start, times, name, **settings).openings
    # a contact that opens for less than a step may be missed
    assert ((counted - expected).abs() <= 1).all()
    assert (counted.diff() >= 0).all()


def test_order_while_contacts_open():
    """The contact law has one and a half derivatives where a contact opens: enough for order 2, not for order 4."""
    chain = tc.Chain(masses(batch=(4,)), contact="hertz")
    start, end = tc.standing_wave(chain, 9, 0.8), torch.tensor([5.0], dtype=torch.float64)
    expected = tc.evolve(chain, start, end, "symplectic4", step=2e-3).displacement
    for name, coarse, lowest, highest in (("verlet", 0.04, 1.9, 2.1), ("symplectic4", 0.08, 2.2, 3.2)):
        found = [tc.evolve(chain, start, end, name, step=coarse / k) for k in (1, 4)]
        assert (found[0].openings > 8).all()
        errors = [(trajectory.displacement - expected).norm().item() for trajectory in found]
        assert lowest < np.log2(errors[0] / errors[1]) / 2 < highest


def test_a_free_flight_is_straight():
    """Between open contacts nothing acts but the precompression: the force on a free particle is zero."""
    chain = tc.Chain(torch.ones(4, dtype=torch.float64), contact="hertz")
    displacement = torch.tensor([0.0, 2.0, 4.0, 6.0], dtype=torch.float64)
    velocity = torch.tensor([0.1, 0.2, 0.3, 0.1], dtype=torch.float64)
    inner = tc.evolve(chain, tc.State(displacement, velocity), time_grid(0.2, 4), "verlet")
    straight = displacement[1:3] + velocity[1:3] * inner.times[:, None]
    assert torch.allclose(inner.displacement[:, 1:3], straight, atol=1e-14)
    assert (inner.openings == 3).all()


def test_collisions_agree_with_scipy():
    """Contacts that open and close again, against an integration that resolves every collision."""
    b = masses(8).numpy()
    chain = tc.Chain(torch.from_numpy(b), contact="hertz")
    start = tc.standing_wave(chain, 2, 1.2)

    def right_hand_side(_, y):
        u, v = np.split(y, 2)
        overlap = np.maximum(1 - (u - np.roll(u, 1)), 0)
        push = 2 / 3 * overlap**1.5
        return np.concatenate([v, (push - np.roll(push, -1)) / b])

    y = np.concatenate([start.displacement, start.velocity])
    times = time_grid(10, 5)
    found = solve_ivp(right_hand_side, (0, 10), y, "DOP853", times.numpy(), rtol=1e-11, atol=1e-12).y
    trajectory = tc.evolve(chain, start, times, "symplectic4", step=0.005)
    assert trajectory.openings[-1] > 2
    assert (trajectory.displacement - torch.from_numpy(found[:8].T)).abs().max() < 1e-5


@pytest.mark.parametrize("elongation", [1.0, 1 - 1e-12, 1 + 1e-12, 1.5, 0.5, -2.0])
def test_slope_of_the_contact_law_where_contacts_open(elongation):
    """sqrt(1 - e), which is zero and not infinite where a contact opens (Eq. 7)."""
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), contact="hertz")
    stretched = torch.full((2,), elongation, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(chain.tension(stretched).sum(), stretched)
    assert slope.tolist() == pytest.approx([max(1 - elongation, 0.0) ** 0.5] * 2, abs=1e-8)


def test_an_ensemble_reports_openings_and_the_energy_balance():
    """What an ensemble keeps and loses stays what the kick gave, while contacts open and damp."""
    observables = ("total_energy", "dissipated", "openings")
    scene = tc.Scene(
        n_particles=16, boundary="fixed", contact="hertz", damping=0.05, energy_definition="bond", realizations=3,
        excitation=tc.Impulse(4, 2.0), times=torch.linspace(0, 20, 5, dtype=torch.float64), observables=observables,
    )  # fmt: skip
    data = tc.simulate(scene, "verlet")
    balance = (data.total_energy + data.dissipated).values
    assert balance == pytest.approx(np.full(5, balance[0]), rel=1e-2)
    assert data.dissipated.values[-1] > 0.2 * balance[0]
    chain = tc.Chain(scene.disorder.masses(16, 3, scene.seed), "fixed", contact="hertz", damping=0.05)
    alone = tc.evolve(chain, tc.impulse(chain, 4, 2.0), scene.times, "verlet")
    assert data.openings.values.tolist() == alone.openings.double().mean(0).tolist()
    assert data.openings.values[-1] > 0
    assert data.dissipated.values == pytest.approx(alone.dissipated.mean(0).numpy(), rel=1e-12)


# --- the guard -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SYMPLECTIC)
def test_a_step_that_collisions_make_unstable_is_caught(name):
    """Stable at the initial overlap, but particles this fast press contacts to many times that."""
    chain = tc.Chain(masses(batch=(2,)), contact="hertz")
    start = tc.standing_wave(chain, 6, 1.0)
    start = tc.State(torch.zeros_like(start.displacement), 20 * start.displacement)
    limit = {"verlet": 2.0, "symplectic4": 2.98944}[name]
    step = 0.9 * limit / symplectic.highest_frequency(chain).amax().item()
    with pytest.raises(EnergyDriftError) as raised:
        tc.evolve(chain, start, time_grid(50, 10), name, step=step)
    text = str(raised.value)
    assert text.startswith("energy must stay within ")
    assert f"method '{name}' with step {step:.4g}: use a smaller step" in text
    assert " at time " in text
    assert "realization" in text
    # the default step allows for all the overlap the energy can give
    trajectory = tc.evolve(chain, start, time_grid(50, 10), name)
    assert (tc.total_energy(chain, trajectory) / initial_energy(chain, start) - 1).abs().max() < 0.02


def test_energy_that_is_not_a_number_is_caught():
    chain = tc.Chain(masses(), contact="hertz")
    start = tc.standing_wave(chain, 6, 0.5)
    nan = tc.Trajectory(time_grid(1, 1), torch.full((2, 24), torch.nan), torch.zeros(2, 24))
    with pytest.raises(EnergyDriftError, match=r"got nan at time 0 \(remedy\)"):
        energy_guard.check(chain, nan, initial_energy(chain, start)[0], 0.1, "remedy")


def test_limit_counts_the_initial_overlap():
    """A contact pressed to overlap 3 is stiffer by sqrt(3), its frequencies higher by 3^(1/4)."""
    chain = tc.Chain(torch.ones(6, dtype=torch.float64), contact="hertz")
    pressed = torch.tensor([0.0, 0.0, 0.0, -2.0, 0.0, 0.0], dtype=torch.float64)
    state = tc.State(pressed, torch.zeros(6))
    limit = 1 / 3**0.25
    with pytest.raises(ValueError, match=f"step must be less than {limit:.6g}, the stability limit 2 / w_max"):
        tc.evolve(chain, state, time_grid(1, 1), "verlet", step=1.01 * limit)
    symplectic.checked_step(chain, state, VERLET, "verlet", 0.99 * limit)


def test_no_overlap_exceeds_what_the_energy_allows():
    chain = tc.Chain(masses(batch=(4,)), contact="hertz")
    start = tc.impulse(chain, 5, 3.0)
    trajectory = tc.evolve(chain, start, time_grid(20, 400), "symplectic4")
    overlap = 1 - chain.elongation(trajectory.displacement).amin((-2, -1))
    bound = symplectic.largest_overlap(chain, start)
    assert (overlap < bound).all()
    assert (overlap > 0.4 * bound).all()


# --- how linear a motion is ------------------------------------------------------------------------------------


def test_force_deviation_is_that_of_the_contact_law():
    chain = tc.Chain(torch.ones(9, dtype=torch.float64), contact="hertz")
    elongation = torch.tensor([-3, -0.5, -1e-3, 1e-3, 0.1, 0.7, 1.0, 1.5, 20.0], dtype=torch.float64)
    exact = (chain.tension(elongation) / elongation - 1).abs()
    assert torch.allclose(force_deviation(elongation), exact, rtol=1e-9)
    small = torch.tensor([-1e-6, 0.0, 1e-6], dtype=torch.float64)
    assert torch.allclose(force_deviation(small), small.abs() / 4, atol=1e-12)


def test_linearity_of_states_and_trajectories():
    chain = tc.Chain(torch.ones(8, dtype=torch.float64), "fixed")
    displacement = torch.tensor([[0, 0, 0.3, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0, 0.1]], dtype=torch.float64)
    of_state = linearity(chain, tc.State(displacement, torch.zeros(2, 8)))
    assert torch.allclose(of_state.elongation, torch.tensor([0.3, 0.1], dtype=torch.float64))
    assert torch.allclose(of_state.stretch, torch.tensor([0.3, 0.1], dtype=torch.float64))
    compressed = linearity(chain, tc.State(-displacement, torch.zeros(2, 8)))
    assert torch.allclose(compressed.elongation, of_state.elongation)
    start = tc.standing_wave(chain, 3, 0.02)
    trajectory = tc.evolve(chain, start, time_grid(5, 10))
    of_trajectory = linearity(chain, trajectory)
    assert of_trajectory.elongation.shape == of_trajectory.force_deviation.shape == (11,)
    assert torch.allclose(of_trajectory.force_deviation, of_trajectory.elongation / 4, rtol=0.02)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_bound_and_estimate_of_the_elongation(boundary):
    chain = tc.Chain(masses(32, (3,)), boundary, stiffness=1.3)
    for start, tight in (
        (tc.impulse(chain, 20, 0.1), 0.4),
        (tc.impulse(chain, 1, 0.1), 0.4),
        (tc.standing_wave(chain, [3, 12], 0.1), 0.6),
    ):
        seen = linearity(chain, tc.evolve(chain, start, time_grid(20, 100))).elongation.amax(-1)
        assert (seen <= elongation_bound(chain, start)).all()
        estimate = elongation_estimate(chain, start)
        assert (estimate <= elongation_bound(chain, start) * (1 + 1e-12)).all()
        assert (seen > tight * estimate).all()
        assert (seen < 3 * estimate).all()


def test_warning_for_amplitudes_beyond_linear_contacts():
    chain = tc.Chain(masses(batch=(2,)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_nonlinear(chain, tc.standing_wave(chain, [3, 7], 0.01))
        warn_if_nonlinear(chain, tc.impulse(chain, 3, 0.01))
        warn_if_nonlinear(chain, tc.State(torch.zeros(2, 24), torch.zeros(2, 24)))
        hertz = tc.Chain(masses(batch=(2,)), contact="hertz")
        warn_if_nonlinear(hertz, tc.standing_wave(hertz, 3, 0.9))
    with pytest.warns(LinearityWarning, match=r"elongations of about 0\.5\d* of the initial overlap at realization 1"):
        warn_if_nonlinear(chain, tc.standing_wave(chain, [3, 11], 0.27))
    with pytest.warns(LinearityWarning, match="contacts would open") as caught:
        warn_if_nonlinear(chain, tc.impulse(chain, 3, 2.0))
    assert "\n" not in str(caught[0].message)
    with pytest.warns(LinearityWarning, match=r"off by 0\.18 %, more than 0\.1 %"):
        warn_if_nonlinear(chain, tc.standing_wave(chain, 3, 0.01), limit=0.001)
