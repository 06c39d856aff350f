"""Contact damping (Eq. 14): closed forms, near-defective matrices, the energy that is lost."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.evolvers import METHODS, start, symplectic
from torchchain.evolvers.compositions import VERLET
from torchchain.evolvers.damped import NearDefectiveWarning, generator

DAMPED = [name for name, entry in METHODS.items() if entry.damped]
ACCURATE = {"damped": {}, "verlet": {"step": 0.001}, "dopri8": {"rtol": 1e-9}}


def time_grid(end, count):
    return torch.linspace(0, end, count + 1, dtype=torch.float64)


def random_chain(boundary="periodic", damping=0.3, n=12, batch=(3,), seed=5):
    generator = torch.Generator().manual_seed(seed)
    masses = 0.5 + torch.rand(*batch, n, generator=generator, dtype=torch.float64)
    rates = damping * torch.rand(*batch, n + (boundary == "fixed"), generator=generator, dtype=torch.float64)
    return tc.Chain(masses, boundary, damping=rates)


def random_state(chain, members=(), seed=6):
    generator = torch.Generator().manual_seed(seed)
    shape = (*chain.batch_shape, *members, chain.n_particles)
    return tc.State(*(0.01 * torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(2)))


def oscillator(t, w, rate, position, speed):
    """x'' + rate x' + w^2 x = 0 in closed form, and its velocity."""
    root = np.emath.sqrt(rate**2 / 4 - w**2)
    cosh = np.cosh(root * t)
    sinh = np.sinh(root * t) / root if root != 0 else t  # over the root
    decay = np.exp(-rate * t / 2)
    x = decay * (position * cosh + (speed + rate / 2 * position) * sinh)
    v = decay * (speed * cosh - (w**2 * position + rate / 2 * speed) * sinh)
    return np.real(x), np.real(v)


@pytest.mark.parametrize("name", ACCURATE)
@pytest.mark.parametrize("damping", [0.1, 2.0, 5.0])
def test_single_oscillator(name, damping):
    """Two particles in step between walls stretch only the wall contacts: m x'' = -x - c x', under, at and over critical."""
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), "fixed", damping=damping)
    state = tc.State(torch.full((2,), 0.02, dtype=torch.float64), torch.full((2,), 0.01, dtype=torch.float64))
    times = time_grid(10, 20)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearDefectiveWarning)
        found = tc.evolve(chain, state, times, name, **ACCURATE[name])
    x, v = oscillator(times.numpy(), 1.0, damping, 0.02, 0.01)
    tolerance = {"damped": 1e-14, "verlet": 1e-7, "dopri8": 1e-9}[name]
    for i in range(2):
        assert np.abs(found.displacement[:, i].numpy() - x).max() < tolerance
        assert np.abs(found.velocity[:, i].numpy() - v).max() < tolerance


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("damping", [0.05, 0.7])
def test_modes_of_an_ordered_chain(boundary, damping):
    """Damping proportional to the stiffness: mode j is an oscillator of frequency w_j and rate c w_j^2."""
    n, times = 16, time_grid(30, 30)
    chain = tc.Chain(torch.ones(n, dtype=torch.float64), boundary, damping=damping)
    modes = tc.normal_modes(replace(chain, damping=0.0))
    for j in (1, 5, n - 1):
        w, shape = modes.frequencies[j].item(), 0.01 * modes.shapes[:, j]
        found = tc.evolve(chain, tc.State(shape, 0.5 * shape), times, "damped")
        x, v = oscillator(times.numpy(), w, damping * w**2, 1.0, 0.5)
        assert (found.displacement - torch.from_numpy(x)[:, None] * shape).abs().max() < 1e-13
        assert (found.velocity - torch.from_numpy(v)[:, None] * shape).abs().max() < 1e-13


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_without_damping_it_is_modes(boundary):
    chain = random_chain(boundary, damping=0.0)
    state = random_state(chain, (2,))
    times = time_grid(100, 50)
    found, expected = (tc.evolve(chain, state, times, name) for name in ("damped", "modes"))
    assert (found.displacement - expected.displacement).abs().max() < 1e-13
    assert (found.velocity - expected.velocity).abs().max() < 1e-13
    assert found.dissipated is None


@pytest.mark.parametrize("name", DAMPED)
def test_a_damped_ring_drifts_at_constant_speed(name):
    chain = random_chain(damping=1.0)
    state = random_state(chain)
    state = tc.State(state.displacement, state.velocity + 0.02)
    settings = {"rtol": 1e-5} if "rtol" in METHODS[name].options else {}
    found = tc.evolve(chain, state, time_grid(4, 4), name, **settings)
    mass = chain.masses.sum(-1, keepdim=True)
    speed = (chain.masses * state.velocity).sum(-1, keepdim=True) / mass
    center = (chain.masses * state.displacement).sum(-1, keepdim=True) / mass + speed * found.times
    found_center = (chain.masses[:, None] * found.displacement).sum(-1) / mass
    assert (found_center - center).abs().max() < 1e-12
    found_speed = (chain.masses[:, None] * found.velocity).sum(-1) / mass
    assert (found_speed - speed).abs().max() < 1e-13


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_critical_damping_is_caught_and_still_exact(boundary):
    """At c w = 2 a mode's matrix is defective; such chains go by matrix exponentials, the others of the batch do not."""
    n = 8
    ones = torch.ones(n, dtype=torch.float64)
    highest = tc.normal_modes(tc.Chain(ones, boundary))
    w, shape = highest.frequencies[-1].item(), 0.01 * highest.shapes[:, -1]
    rates = torch.tensor([0.1, 2 / w, 2 / w * (1 + 1e-13)], dtype=torch.float64)
    n_contacts = n + (boundary == "fixed")
    chain = tc.Chain(ones.expand(3, n), boundary, damping=rates[:, None].expand(3, n_contacts))
    state = tc.State(shape.expand(3, n), -0.3 * shape.expand(3, n))
    # equally spaced, with a gap, and irregular
    times = torch.cat([time_grid(3, 30), torch.tensor([3.5, 3.9, 7.0], dtype=torch.float64)])
    with pytest.warns(NearDefectiveWarning, match=r"eigenvectors of 2 of 3 damped chains .* at realization [23]"):
        advance = start(chain, state, "damped")
    pieces = [advance(times[:7]), advance(times[7:])]
    displacement = torch.cat([piece.displacement for piece in pieces], -2)
    velocity = torch.cat([piece.velocity for piece in pieces], -2)
    for i, rate in enumerate(rates.tolist()):
        x, v = oscillator(times.numpy(), w, rate * w**2 if i != 2 else 2 * w, 1.0, -0.3)
        assert (displacement[i] - torch.from_numpy(x)[:, None] * shape).abs().max() < 1e-13
        assert (velocity[i] - torch.from_numpy(v)[:, None] * shape).abs().max() < 1e-13


@pytest.mark.parametrize("distance", [1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2])
def test_exact_at_any_distance_from_critical_damping(distance):
    """Whichever of the two ways a matrix takes, its result is right to what its conditioning allows."""
    chain = tc.Chain(torch.ones(2, dtype=torch.float64), "fixed", damping=2 * (1 + distance))
    state = tc.State(torch.full((2,), 0.02, dtype=torch.float64), torch.zeros(2))
    times = time_grid(5, 5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NearDefectiveWarning)
        found = tc.evolve(chain, state, times, "damped")
    x, _ = oscillator(times.numpy(), 1.0, 2.0, 0.02, 0.0)
    # how far the motion itself moves with the damping
    moved = 0.02 * 3 * distance
    assert np.abs(found.displacement[:, 0].numpy() - x).max() < moved + 1e-11


def test_well_conditioned_in_the_energy_norm():
    """Disordered chains, weakly damped, have nearly orthogonal eigenvectors in the variables chosen."""
    chain = random_chain(damping=0.1, n=64)
    modes = tc.normal_modes(replace(chain, damping=0.0))
    rate = chain.elongation(modes.shapes[..., 1:].mT)
    matrix = generator(modes.frequencies[..., 1:], rate @ (chain.contact_damping[..., None] * rate.mT))
    assert torch.linalg.cond(torch.linalg.eig(matrix)[1]).max() < 10


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
@pytest.mark.parametrize("name", ACCURATE)
def test_dissipated_energy(name, boundary):
    """What is lost is the time integral of the damping power, taken here from the velocities by Simpson's rule."""
    chain = random_chain(boundary)
    state = random_state(chain, (2,))
    times = time_grid(3, 300)
    found = tc.evolve(chain, state, times, name, **ACCURATE[name])
    rate = chain.elongation(found.velocity)
    power = (chain.contact_damping[:, None, None] * rate.square()).sum(-1)
    h = times[1] - times[0]
    integral = (h / 3 * (power[..., 0:-2:2] + 4 * power[..., 1:-1:2] + power[..., 2::2])).cumsum(-1)
    energy = tc.total_energy(chain, found)
    initial = energy[..., :1]
    tolerance = {"damped": 1e-8, "verlet": 1e-5, "dopri8": 1e-8}[name]
    assert ((found.dissipated[..., 2::2] - integral) / initial).abs().max() < tolerance
    assert ((energy + found.dissipated) / initial - 1).abs().max() < tolerance
    assert (found.dissipated.diff() >= 0).all()
    assert found.dissipated[..., -1].min() > 0.2 * initial.min()
    assert found.dissipated.shape == (3, 2, 301)


def test_damped_verlet_near_both_limits():
    """Its energy never grows beyond Verlet's own swing, whatever the damping, up to the stated limits."""
    chain = random_chain(damping=1.0, n=32)
    state = random_state(chain)
    highest = symplectic.highest_frequency(chain).amax().item()
    rate = symplectic.damping_rate(chain).amax().item()
    # scaled so that both limits are reached at once
    chain = replace(chain, damping=chain.damping * highest / rate)
    step = 0.99 * 2 / highest
    found = tc.evolve(chain, state, 1000.0 * step * time_grid(4, 4), "verlet", step=step)
    energy = tc.total_energy(chain, found)
    assert energy.max() < 60 * energy[:, :1].max()
    assert (energy[:, -1] < energy[:, 0]).all()


def test_step_beyond_the_damping_limit_is_refused():
    chain = tc.Chain(torch.ones(2, 6, dtype=torch.float64), damping=torch.tensor([[0.1], [5.0]]).expand(2, 6))
    state = random_state(chain)
    # ordered ring: the largest eigenvalue of M^-1 D is 4 c
    with pytest.raises(
        ValueError, match=r"step must be less than 0\.1, the stability limit 2 / d_max of method"
    ) as raised:
        tc.evolve(chain, state, time_grid(1, 1), "verlet", step=0.101)
    assert str(raised.value).endswith("'verlet' with d_max = 20 at realization 2, got 0.101")
    tc.evolve(chain, state, time_grid(1, 1), "verlet", step=0.0999)
    diverged = symplectic.stepping(chain, state, VERLET, 0.12)(time_grid(120, 1))
    assert diverged.displacement[1, -1].abs().max() > 1e6


@pytest.mark.parametrize("name", ["verlet", "dopri5"])
def test_an_open_contact_does_not_damp(name):
    """A particle that has lost both contacts keeps its velocity, however large the damping."""
    chain = tc.Chain(torch.ones(4, dtype=torch.float64), contact="hertz", damping=0.5)
    displacement = torch.tensor([0.0, 2.0, 4.0, 6.0], dtype=torch.float64)
    velocity = torch.tensor([0.1, 0.2, 0.3, 0.1], dtype=torch.float64)
    found = tc.evolve(chain, tc.State(displacement, velocity), time_grid(0.2, 2), name)
    assert torch.allclose(found.velocity[:, 1:3], velocity[1:3].expand(3, 2), atol=1e-14)


def test_the_chains_damping_force_follows_the_same_rule():
    chain = tc.Chain(torch.ones(4, dtype=torch.float64), "fixed", contact="hertz", damping=0.5)
    displacement = torch.tensor([0.0, 1.0, 0.5, 0.5], dtype=torch.float64)  # the second contact has just opened
    velocity = torch.tensor([0.1, 0.4, 0.2, -0.3], dtype=torch.float64)
    assert chain.active_damping(displacement).tolist() == [0.5, 0.0, 0.5, 0.5, 0.5]
    pull = torch.tensor([0.05, 0.0, -0.1, -0.25, 0.15], dtype=torch.float64)
    assert torch.allclose(chain.damping_force(velocity, displacement), pull.diff(), atol=1e-15)
    with pytest.raises(ValueError, match="displacement must be given for Hertz contacts"):
        chain.damping_force(velocity)
    linear = replace(chain, contact="linear")
    assert torch.equal(linear.damping_force(velocity, displacement), linear.damping_force(velocity))


def test_damped_collisions_by_two_unrelated_methods():
    """Hertz contacts that open while damped: the states and the energy balance of both."""
    chain = random_chain("fixed", damping=0.1, n=10, batch=())
    chain = replace(chain, contact="hertz")
    state = tc.standing_wave(chain, 4, 1.0)
    times = time_grid(10, 5)
    one = tc.evolve(chain, state, times, "verlet", step=5e-4)
    other = tc.evolve(chain, state, times, "dopri5", rtol=1e-9)
    assert one.openings[-1] > 0
    assert (one.openings == other.openings).all()
    assert (one.displacement - other.displacement).abs().max() < 1e-4
    for found in (one, other):
        energy = tc.total_energy(chain, found) + found.dissipated
        assert (energy / energy[0] - 1).abs().max() < 1e-4


@pytest.mark.parametrize("name", [name for name in METHODS if name not in DAMPED])
def test_methods_without_damping_refuse_it(name):
    chain = random_chain(METHODS[name].boundaries[0])
    with pytest.raises(ValueError, match=f"damping must be zero for method '{name}'.*got up to 0.2"):
        tc.evolve(chain, random_state(chain), time_grid(1, 1), name)
