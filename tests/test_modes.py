"""Exact evolution by normal modes against closed forms (the conformance of every method is in test_evolvers)."""

import numpy as np
import pytest
import torch
from literal import states, stiffness_matrix
from scipy import special

import torchchain as tc


def disordered(n, boundary, realizations=3, seed=0):
    return tc.Chain(tc.Disorder("normal", 0.3).masses(n, realizations, seed), boundary)


def random_state(shape, seed=0):
    generator = torch.Generator().manual_seed(seed)
    u, v = torch.randn(2, *shape, dtype=torch.float64, generator=generator)
    return tc.State(u, v)


def test_kick_of_the_infinite_chain():
    # v_n(t) = v0 J_2n(2 t) until the fronts meet at the far side of the ring, t = N / 2.
    n, site, v0 = 256, 100, 0.03
    chain = tc.Chain(torch.ones(n, dtype=torch.float64))
    times = np.array([0.0, 0.3, 1.0, 7.5, 40.0, 100.0])
    moved = tc.evolve(chain, tc.impulse(chain, site, v0), times)
    offset = (np.arange(1, n + 1) - site + n // 2) % n - n // 2
    bessel = special.jv(2 * np.abs(offset), 2 * times[:, None])
    np.testing.assert_allclose(moved.velocity.numpy(), v0 * bessel, atol=1e-13 * v0)
    # and the displacement is its integral; at the site itself int_0^t J_0(2 s) ds
    center = special.jv(2 * np.arange(200) + 1, 2 * times[:, None]).sum(-1)  # int_0^x J_0 = 2 sum of J_1, J_3, ...
    np.testing.assert_allclose(moved.displacement[:, site - 1].numpy(), v0 * center, atol=1e-10 * v0)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_displacement_and_velocity_together(boundary):
    chain = disordered(20, boundary)
    state = random_state((3, 2, 20))
    times = [0.0, 1.0, 17.0, 300.0]
    moved = tc.evolve(chain, state, times)
    assert moved.velocity.shape == moved.displacement.shape == (3, 2, 4, 20)
    for i, j in np.ndindex(3, 2):
        matrix = stiffness_matrix(np.ones(chain.n_contacts), 20, boundary)
        u, v = states(
            chain.masses[i].numpy(), matrix, state.displacement[i, j].numpy(), state.velocity[i, j].numpy(), times
        )
        # The generalized solver gives the lowest w to 1e-14 or so: phases to 3e-12 at t = 300.
        np.testing.assert_allclose(moved.displacement[i, j].numpy(), u, atol=1e-10)
        np.testing.assert_allclose(moved.velocity[i, j].numpy(), v, atol=1e-10)


def test_superposition():
    chain = disordered(16, "periodic")
    a, b = random_state((3, 16)), random_state((3, 16), seed=1)
    times = [0.5, 20.0]
    both, one, two = (tc.evolve(chain, s, times) for s in (a + b, a, b))
    assert torch.allclose(both.displacement, one.displacement + two.displacement, atol=1e-13)
    assert torch.allclose(both.velocity, one.velocity + two.velocity, atol=1e-13)


def test_a_ring_with_net_momentum_drifts_at_constant_speed():
    chain = disordered(24, "periodic")
    state = random_state((3, 24))
    total = chain.masses.sum(-1)
    speed = (chain.masses * state.velocity).sum(-1) / total
    begin = (chain.masses * state.displacement).sum(-1) / total
    times = torch.tensor([0.0, 1.0, 1e3, 1e6], dtype=torch.float64)
    moved = tc.evolve(chain, state, times)
    center = (chain.masses[:, None] * moved.displacement).sum(-1) / total[:, None]
    expected = begin[:, None] + speed[:, None] * times
    assert torch.allclose(center, expected, rtol=1e-13, atol=1e-13)
    momentum = (chain.masses[:, None] * moved.velocity).sum(-1)
    assert torch.allclose(momentum, (speed * total)[:, None].expand(3, 4), rtol=0, atol=1e-13 * 24)


def test_a_rigid_ring_moves_rigidly():
    chain = disordered(10, "periodic", 1)
    state = tc.State(torch.full((1, 10), 2.0), torch.full((1, 10), 0.5))
    moved = tc.evolve(chain, tc.State(state.displacement.double(), state.velocity.double()), [0.0, 1e5])
    expected = torch.tensor([2.0, 2.0 + 0.5e5], dtype=torch.float64)[None, :, None].expand(1, 2, 10)
    assert torch.allclose(moved.displacement, expected, rtol=1e-13)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_time_reversal(boundary):
    chain = disordered(20, boundary)
    state = random_state((3, 20))
    end = tc.evolve(chain, state, [77.0]).final
    back = tc.evolve(chain, tc.State(end.displacement, -end.velocity), [77.0]).final
    assert torch.allclose(back.displacement, state.displacement, atol=1e-12)
    assert torch.allclose(back.velocity, -state.velocity, atol=1e-12)


def test_reciprocity():
    # A force at p moves q as the same force at q moves p: b_p v_q(t) from a unit velocity at p is symmetric.
    chain = disordered(12, "fixed", 1)
    kicks = tc.State(torch.zeros(1, 12, 12, dtype=torch.float64), torch.eye(12, dtype=torch.float64)[None])
    velocity = tc.evolve(chain, kicks, [5.0, 33.0]).velocity[0]  # (kicked, time, moved)
    green = velocity.movedim(1, 0) / chain.masses[0][:, None]  # per unit momentum
    assert torch.allclose(green, green.mT, atol=1e-13)


def test_modes_at_hand_are_used():
    chain = disordered(12, "periodic")
    state = random_state((3, 12))
    assert torch.equal(
        tc.evolve(chain, state, [3.0], modes=tc.normal_modes(chain)).velocity, tc.evolve(chain, state, [3.0]).velocity
    )
