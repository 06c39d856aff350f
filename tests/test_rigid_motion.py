"""Energies of a ring do not depend on where it is: its motion as a whole is not energy of any site."""

import math

import pytest
import torch

import torchchain as tc


def a_ring(n=24, seed=0):
    return tc.Chain(tc.Disorder().masses(n, 2, seed), stiffness=tc.Disorder().stiffnesses(n, 2, seed))


@pytest.mark.parametrize("definition", ["site", "bond"])
def test_energies_of_a_ring_moved_as_a_whole(definition):
    ring = a_ring()
    trajectory = tc.evolve(ring, tc.standing_wave(ring, 3), [0.0, 7.0, 90.0])
    moved = tc.Trajectory(trajectory.times, trajectory.displacement + 50.0, trajectory.velocity)
    for energy in (tc.particle_energy, tc.wavenumber_energy):
        found, expected = (energy(ring, each, definition=definition) for each in (moved, trajectory))
        # forces, whose terms are 50 stiffnesses large, times displacements
        assert (found - expected).abs().max() < 100 * 50 * 2.3e-16 * trajectory.displacement.abs().max()


@pytest.mark.parametrize("compiled", [True, False])
def test_kernels_take_the_same_motion_out(compiled):
    ring = a_ring()
    start = tc.impulse(ring, 5, 0.01)
    times = torch.tensor([0.0, 0.5, 3.0, 40.0, 3000.0], dtype=torch.float64)
    trajectory = tc.evolve(ring, start, times, "modes")
    energy = tc.particle_energy(ring, trajectory)
    moments = tc.energy_moments(ring, start, times, compiled=compiled)
    torch.testing.assert_close(moments.center, tc.energy_center(energy), rtol=0, atol=1e-7)
    torch.testing.assert_close(moments.width, tc.energy_width(energy), rtol=0, atol=1e-6)
    torch.testing.assert_close(moments.total, tc.total_energy(ring, trajectory), rtol=1e-11, atol=0)


@pytest.mark.parametrize("method", ["modes", "chebyshev"])
def test_the_energy_of_a_kicked_ring_stays_on_it(method):
    scene = tc.Scene(
        n_particles=64, disorder=tc.Disorder(strength=0.1), excitation=tc.Impulse(32), times=[10.0, 1000.0, 1e5],
        observables=("width", "source_energy"), realizations=2,
    )  # fmt: skip
    found = tc.simulate(scene, method)
    assert (found.width.values > 0).all()
    assert (found.width.values < 64**2).all()
    assert (abs(found.source_energy.values) < 0.5e-4 * 2).all(), "no site has more than there is, but for signs"


def test_finite_ring_corrects_the_infinite_chain():
    """Unwrapped, the motion as a whole adds 2 t^2 / N to r^2 by sites: half of it times the second moment of the forces."""
    n, t = 256, torch.tensor([20.0, 60.0, 100.0], dtype=torch.float64)
    ring, rod = (tc.Chain(torch.ones(n, dtype=torch.float64), boundary) for boundary in ("periodic", "fixed"))
    width = [
        tc.energy_width(tc.particle_energy(chain, tc.evolve(chain, tc.impulse(chain, 128), t))) for chain in (ring, rod)
    ]
    torch.testing.assert_close(width[0] - width[1], 2 * t**2 / n, rtol=1e-9, atol=0)
    assert math.isclose(width[1][-1].item(), 100**2 / 2 - 50 + 1 / 8, rel_tol=1e-4)
