"""Every method at the edge where it fails: the edge is where theory puts it, and the library says so before it is crossed."""

from __future__ import annotations

import math
import sys
import warnings
from pathlib import Path

import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.evolvers.symplectic import MOST_STEPS
from torchchain.master import Calibration
from torchchain.master.equation import PredictionWarning
from torchchain.master.fits import FitWarning, nonlinear_rates
from torchchain.modes.phase import PhaseWarning
from torchchain.modes.spectrum import DecompositionError, SpectrumWarning

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "experiments"))

import failure_map

EDGES = {edge.name: edge for edge in failure_map.edges(seed=0)}
GUARDED = [name for name, edge in EDGES.items() if edge.public is not None]
HALVINGS = 9
PAIRS = "-0.4 0.3 0.1; 0.2 -0.5 0.3; 0.1 0.2 -0.3"
EXTREME = 1e8


def tensor(text):
    return torch.tensor([[float(x) for x in row.split()] for row in text.split(";")], dtype=torch.float64)


def equation(rates, damping=None):
    scene = tc.Scene(n_particles=8 * len(rates), n_bands=len(rates), realizations=2)
    model = tc.RateModel(rates, torch.zeros_like(rates[0]), damping)
    return tc.MasterEquation(model, Calibration("linear", "paper", None, scene))


def first(bands, dtype=torch.float64):
    return torch.eye(bands, dtype=dtype)[0]


@pytest.mark.parametrize("name", EDGES)
def test_the_edge_is_where_theory_puts_it(name):
    edge = EDGES[name]
    place = failure_map.found(edge, HALVINGS)
    assert edge.predicted / edge.factor <= place <= edge.predicted * edge.factor


@pytest.mark.parametrize("name", GUARDED)
def test_beyond_its_edge_a_method_says_so_with_a_number(name):
    edge = EDGES[name]
    said = failure_map.answer(edge.public, 1.1 * edge.factor * edge.predicted)
    assert said, "silent beyond its edge"
    assert any(character.isdigit() for character in said)


@pytest.mark.parametrize("name", GUARDED)
def test_well_inside_its_edge_a_method_works(name):
    edge = EDGES[name]
    assert "Error" not in failure_map.answer(edge.public, 0.2 * edge.predicted)


def test_the_theory_of_disorder_fails_with_the_disorder_and_most_for_binary_masses():
    config = failure_map.Config(
        n_particles=64, n_bands=8, realizations=60, strengths=(0.1, 0.5), binary=(0.5,), stop=16.0
    )
    weak, strong, binary = failure_map.theory_off(config)
    assert float(weak.max()) < failure_map.FAILS
    assert float(weak.mean()) < float(strong.mean()) < float(binary.mean())
    assert float(binary.max()) > 2 * failure_map.FAILS
    assert float(strong.isel(source=0).max()) < failure_map.FAILS  # the longest waves


def test_every_stability_limit_of_the_registry_is_on_the_map():
    from torchchain.evolvers import ode
    from torchchain.master.solving import STABILITY

    assert {f"{name}: |lambda| step" for name in STABILITY} <= EDGES.keys()
    limited = {solver.name for solver in ode.FIXED if solver.limit is not None and solver.name != "implicit_adams"}
    assert {f"{name}: w_max step" for name in (*limited, "verlet", "symplectic4")} <= EDGES.keys()


@pytest.mark.parametrize(("method", "limit"), [("euler", 2.0), ("midpoint", 2.0), ("rk4", 2.7852935634)])
def test_stiff_damping_limits_the_step(method, limit):
    drain = torch.tensor([0.0, 0.0, 50.0], dtype=torch.float64)
    master = equation(tensor(PAIRS), drain)
    fastest = torch.linalg.eigvals(tensor(PAIRS) - torch.diag(drain)).abs().max().item()
    with pytest.raises(FieldError, match=f"step must be at most {limit / fastest:.4g}"):
        master.solve(first(3), [1.0], method, step=1.01 * limit / fastest)
    solved = master.solve(first(3), [1.0], method, step=0.1 / fastest)
    torch.testing.assert_close(solved, master.solve(first(3), [1.0]), rtol=5e-3, atol=1e-4)


def test_rates_that_differ_by_ten_thousand():
    rates = tensor(PAIRS)
    rates[0] *= 1e4
    master = equation(rates)
    times = [0.001, 0.1, 2.0]
    exact = master.solve(first(3), times)
    torch.testing.assert_close(master.solve(first(3), times, "scipy_solver"), exact, rtol=0, atol=1e-6)
    with pytest.raises(FieldError, match="step must be at most"):
        master.solve(first(3), times, "rk4", step=0.01)
    with pytest.raises(FieldError, match="steps of"):
        master.solve(first(3), [0.001, 1e5], "rk4")


@pytest.mark.parametrize("method", ["dopri8", "dopri5", "bosh3", "fehlberg2", "adaptive_heun", "scipy_solver"])
def test_tolerances_below_rounding_are_refused(method):
    master = equation(tensor(PAIRS).float())
    with pytest.raises(FieldError, match=r"rtol must be at least 4.76\d*e-07, got 1e-09"):
        master.solve(first(3, torch.float32), [10.0], method, rtol=1e-9)
    eps = torch.finfo(torch.float32).eps
    exact = equation(tensor(PAIRS)).solve(first(3), [10.0])
    solved = master.solve(first(3, torch.float32), [10.0], method)
    assert (solved - exact).abs().max() < 100 * 16 * eps, "a hundred steps, each within the default tolerance"


@pytest.mark.parametrize(("method", "order"), [("heun3", 3), ("rk4", 4)])
def test_outputs_between_steps_keep_the_order(method, order):
    master = equation(tensor(PAIRS))
    times = torch.linspace(0, 7, 50, dtype=torch.float64)  # no multiples of the steps
    exact = master.solve(first(3), times)
    errors = [(master.solve(first(3), times, method, step=step) - exact).abs().max() for step in (0.2, 0.1, 0.05)]
    for coarse, fine in zip(errors[:-1], errors[1:], strict=True):
        assert math.log2(coarse / fine) == pytest.approx(order, abs=0.35)


@pytest.mark.parametrize("method", ["expm", "dopri5", "rk4"])
def test_energy_that_grows_beyond_all_numbers(method):
    rates = (tensor(PAIRS) + 0.5 * torch.eye(3)).float()
    end = math.log(3 * torch.finfo(torch.float32).max) / 0.5
    with pytest.raises(tc.master.IntegrationError):
        equation(rates).solve(first(3, torch.float32), [1.05 * end], method)


def test_energy_that_is_made_or_negative_is_reported():
    with pytest.warns(PredictionWarning, match=r"grown by 0\.1\d .*conservation_defect 0\.01\b"):
        equation(tensor(PAIRS) + 0.01 * torch.eye(3)).solve(first(3), [1.0, 10.0])
    negative = tensor("-0.2 -0.2 0.4; 0.1 -0.3 0.2; 0.1 0.2 -0.3")
    with pytest.warns(PredictionWarning, match=r"lowest predicted energy of a band is -0\.1"):
        equation(negative).solve(first(3), torch.arange(11.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        equation(tensor(PAIRS)).solve(first(3), torch.arange(11.0))


def test_nonlinear_fit_of_flat_curves():
    times = torch.arange(21, dtype=torch.float64) / 4
    generator = torch.Generator().manual_seed(0)
    flat = torch.full((4, 21, 4), 0.25, dtype=torch.float64)
    for mean in (flat, flat + 1e-9 * torch.randn(flat.shape, generator=generator, dtype=torch.float64)):
        rates, converged, _ = nonlinear_rates(times, mean, torch.ones(4, dtype=torch.float64), (0.5, 4.5))
        assert not converged.any()
        assert not rates.any()


def test_nonlinear_fit_says_how_many_curves_were_flat(small_transfer):
    with pytest.warns(FitWarning, match=r"did not converge for \d+ of 16 pairs"):
        rates = tc.calibrate(small_transfer, "nonlinear", "paper").rates
    assert rates.isfinite().all()


# Frequencies and modes.


def test_single_precision_modes():
    chain = tc.Chain(tc.Disorder().masses(256, 1, 0)[0].float())
    weight = chain.masses.rsqrt()
    values = torch.linalg.eigvalsh(-chain.stiffness_matrix() * weight[:, None] * weight)
    assert values[0] < 0 or values[0] > 1e-9, "the solver alone does not find the zero mode"
    modes = tc.normal_modes(chain)
    exact = tc.normal_modes(tc.Chain(chain.masses.double())).frequencies
    eps = torch.finfo(torch.float32).eps
    assert modes.frequencies[0] == 0
    assert (modes.frequencies[1:] > 0).all()
    assert (modes.frequencies.double().square() - exact.square()).abs().max() < eps * 256**0.5 * exact[-1] ** 2
    gram = modes.shapes.mT @ (chain.masses[:, None] * modes.shapes)
    assert (gram - torch.eye(256)).abs().max() < 40 * eps * 256**0.5


def test_phases_blurred_by_single_precision():
    chain = tc.Chain(tc.Disorder().masses(64, 1, 0)[0].float())
    state = tc.impulse(chain, 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.evolve(chain, state, [500.0], "modes")
    with pytest.warns(PhaseWarning, match=r"at time 5000: w t eps = \d"):
        tc.evolve(chain, state, [5000.0], "modes")
    with pytest.raises(FieldError, match="times must be less than"):
        tc.evolve(chain, state, [1e7], "modes")


@pytest.mark.parametrize("method", ["chebyshev", "verlet", "symplectic4"])
def test_a_very_light_particle_does_not_hang_a_method(method):
    masses = torch.ones(3, 16, dtype=torch.float64)
    masses[1, 5] = 1e-30
    chain = tc.Chain(masses)
    with pytest.raises(FieldError, match="times must") as raised:
        tc.evolve(chain, tc.impulse(chain, 2), [20.0], method)
    assert "e+" in str(raised.value) or f"{MOST_STEPS:.0e}" in str(raised.value)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_mass_ratio_of_a_hundred_million(boundary):
    masses = torch.ones(64, dtype=torch.float64)
    masses[20], masses[40] = EXTREME**-0.5, EXTREME**0.5
    chain = tc.Chain(masses, boundary)
    states = {}
    for method in ("modes", "chebyshev", *(["tridiagonal"] if boundary == "fixed" else [])):
        trajectory = tc.evolve(chain, tc.impulse(chain, 10), [50.0], method)
        energy = tc.total_energy(chain, trajectory)
        assert (energy / 0.5e-4 - 1).abs() < 1e-11
        states[method] = trajectory.velocity
    for velocity in states.values():
        torch.testing.assert_close(velocity, states["chebyshev"], rtol=0, atol=1e-11)


def test_mass_ratio_beyond_double_precision():
    masses = torch.ones(64, dtype=torch.float64)
    masses[20], masses[40] = 1e-9, 1e9
    chain = tc.Chain(masses, "fixed")
    with pytest.warns(SpectrumWarning, match="times the median"):
        tc.normal_modes(chain)
    with pytest.raises(DecompositionError, match="residual"):
        tc.normal_modes(tc.Chain(masses.float()))


@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet", "symplectic4", "damped", "dopri5"])
def test_a_ring_drifts_with_its_momentum(method):
    chain = tc.Chain(tc.Disorder().masses(32, 2, 0))
    still = torch.zeros_like(chain.masses)
    drifting = tc.State(still, still + 0.01)
    trajectory = tc.evolve(chain, drifting, [0.0, 1000.0], method)
    torch.testing.assert_close(trajectory.displacement[:, 1], still + 10, rtol=1e-9, atol=0)
    bands = tc.band_energy(chain, trajectory, 4)
    assert bands.abs().max() < 1e-12, "the energy is at k = 0, in no band"


def test_gradients_through_degenerate_modes():
    masses = torch.ones(16, dtype=torch.float64, requires_grad=True)
    chain = tc.Chain(masses)
    outcome = tc.evolve(chain, tc.impulse(chain, 3), [3.0], "modes").velocity[..., 5].sum()
    with pytest.raises(DecompositionError, match=r"must differ in frequency .* differ by .*chebyshev"):
        outcome.backward()
    tc.evolve(chain, tc.impulse(chain, 3), [3.0], "chebyshev").velocity[..., 5].sum().backward()
    assert masses.grad.isfinite().all()


def test_gradients_through_nearly_degenerate_modes():
    masses = torch.ones(16, dtype=torch.float64) + 1e-7 * torch.arange(16)
    found = []
    for method in ("modes", "chebyshev"):
        leaf = masses.clone().requires_grad_()
        chain = tc.Chain(leaf)
        tc.evolve(chain, tc.impulse(chain, 3), [3.0], method).velocity[..., 5].sum().backward()
        found.append(leaf.grad)
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=1e-9)


def test_long_time_average_of_degenerate_pairs():
    """At vanishing disorder an impulse on a ring shares its energy as the ordered ring does: no basis of a pair is special."""
    ordered = tc.Chain(torch.ones(64, dtype=torch.float64))
    exact = tc.long_time_band_energy(ordered, tc.impulse(ordered, 3), 4)
    later = torch.linspace(0, 20000, 4001, dtype=torch.float64)
    mean = tc.band_energy(ordered, tc.evolve(ordered, tc.impulse(ordered, 3), later), 4).mean(-2)
    torch.testing.assert_close(exact, mean, rtol=0, atol=2e-3)
    mixed = tc.standing_wave(ordered, 10) + tc.standing_wave(ordered, 10, phase="cos")
    pure = tc.long_time_band_energy(ordered, mixed, 4)
    torch.testing.assert_close(pure, torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-12)


def test_linear_contacts_that_open():
    chain = tc.Chain(torch.ones(32, dtype=torch.float64), "fixed")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.evolve(chain, tc.impulse(chain, 5, 0.5), [5.0])
    with pytest.warns(tc.LinearityWarning, match=r"elongations of about 3 .*contacts would open"):
        tc.evolve(chain, tc.impulse(chain, 5, 3.0), [5.0])
    hertz = tc.Chain(chain.masses, "fixed", contact="hertz")
    assert tc.evolve(hertz, tc.impulse(hertz, 5, 3.0), [5.0], "verlet").openings.sum() > 0


# One bad chain in a batch of a hundred.


@pytest.fixture(scope="module")
def hundred():
    return tc.Disorder().masses(64, 100, 0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1.0, 0.0])
def test_one_impossible_chain_is_named(hundred, bad):
    masses = hundred.clone()
    masses[37, 10] = bad
    with pytest.raises(FieldError, match=r"^masses must be .* at realization 38, "):
        tc.Chain(masses)


@pytest.mark.parametrize("bad", [1e-30, 1e-300, 1e30])
@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet", "symplectic4"])
def test_one_extreme_chain_is_refused_or_right(hundred, method, bad):
    masses = hundred.clone()
    masses[37, 10] = bad
    chain = tc.Chain(masses)
    options = {"step": 0.05} if method in ("verlet", "symplectic4") else {}
    if bad < 1:
        with pytest.raises((FieldError, DecompositionError)) as raised:
            tc.evolve(chain, tc.impulse(chain, 5), [20.0], method, **options)
        assert "realization 38" in str(raised.value) or method == "chebyshev"
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SpectrumWarning)
        velocity = tc.evolve(chain, tc.impulse(chain, 5), [20.0], method, **options).velocity
    usual = tc.Chain(hundred)
    expected = tc.evolve(usual, tc.impulse(usual, 5), [20.0], method, **options).velocity
    others = torch.arange(100) != 37
    assert torch.equal(velocity[others], expected[others]), "to the last bit"
    assert velocity[37].isfinite().all()
    assert velocity[37, 0, 10].abs() < 1e-12, "as good as a wall"


@pytest.mark.parametrize("method", ["modes", "chebyshev", "verlet", "symplectic4"])
def test_a_chain_next_to_a_light_one_is_the_same_to_the_last_bit(hundred, method):
    masses = hundred.clone()
    masses[37, 10] = 1e-3
    options = {"step": 0.01} if method in ("verlet", "symplectic4") else {}
    found = []
    for batch in (masses, hundred):
        chain = tc.Chain(batch)
        found.append(tc.evolve(chain, tc.impulse(chain, 5), [20.0], method, **options).velocity)
    others = torch.arange(100) != 37
    assert torch.equal(found[0][others], found[1][others])
    assert not torch.equal(found[0][37], found[1][37])
