import numpy as np
import pytest
import torch
from literal import stiffness_matrix
from scipy import special

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError


def moving(n=14, boundary="periodic", realizations=3, stiffness=True, times=(0.0, 2.0, 55.0), contact="linear"):
    masses = tc.Disorder("normal", 0.3).masses(n, realizations, 1)
    kappa = tc.Disorder("uniform", 0.3).stiffnesses(n + (boundary == "fixed"), realizations, 1) if stiffness else 1.0
    chain = tc.Chain(masses, boundary, kappa, contact)
    generator = torch.Generator().manual_seed(0)
    u, v = 0.3 * torch.randn(2, realizations, n, dtype=torch.float64, generator=generator)
    linear = tc.Chain(masses, boundary, kappa)
    return chain, tc.evolve(linear, tc.State(u, v), times)


def each(chain, trajectory):
    """Masses, K, displacement and velocity of every realization and time."""
    for i, t in np.ndindex(*trajectory.velocity.shape[:2]):
        matrix = stiffness_matrix(chain.contact_stiffness[i].numpy(), chain.n_particles, chain.boundary)
        state = trajectory.displacement[i, t].numpy(), trajectory.velocity[i, t].numpy()
        yield (i, t), chain.masses[i].numpy(), matrix, *state


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_site_energies_are_the_diagonals_of_the_matrices(boundary):
    chain, trajectory = moving(boundary=boundary)
    kinetic = tc.kinetic_energy(chain, trajectory)
    potential = tc.potential_energy(chain, trajectory)
    total = tc.particle_energy(chain, trajectory)
    matrices = tc.energy_matrices(chain, trajectory)
    for at, masses, matrix, u, v in each(chain, trajectory):
        ke = np.diag(masses) @ np.outer(v, v) / 2  # Eq. 29
        if boundary == "periodic":
            u = u - (masses * u).sum() / masses.sum()  # the ring's motion as a whole has no energy of contacts
        pe = -matrix @ np.outer(u, u) / 2  # Eq. 32
        rounding = 1e-14 * (1 + abs(u).max()) ** 2  # of K u u^T, whose terms cancel
        for part, expected in ((kinetic, ke), (potential, pe), (total, ke + pe)):
            np.testing.assert_allclose(part[at].numpy(), np.diag(expected), rtol=0, atol=rounding)
        for part, expected in ((matrices.kinetic, ke), (matrices.potential, pe), (matrices.total, ke + pe)):
            np.testing.assert_allclose(part[at].numpy(), expected, rtol=0, atol=rounding)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_bond_energies(boundary):
    chain, trajectory = moving(boundary=boundary)
    potential = tc.potential_energy(chain, trajectory, "bond")
    for at, _, _, u, _ in each(chain, trajectory):
        kappa = chain.contact_stiffness[at[0]].numpy()
        n = len(u)
        expected = np.zeros(n)
        for contact in range(len(kappa)):
            left, right = contact - 1, contact
            if boundary == "periodic":
                left %= n
            e = (u[right] if right < n else 0) - (u[left] if left >= 0 else 0)
            ends = [p for p in (left, right) if 0 <= p < n]
            for p in ends:
                expected[p] += kappa[contact] * e**2 / 2 / len(ends)
        np.testing.assert_allclose(potential[at].numpy(), expected, rtol=1e-13, atol=1e-16)


@pytest.mark.parametrize("contact", ["linear", "hertz"])
@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_definitions_share_one_sum(boundary, contact):
    chain, trajectory = moving(boundary=boundary, contact=contact)
    total = tc.total_energy(chain, trajectory)
    assert total.shape == (3, 3)
    bond = tc.particle_energy(chain, trajectory, "bond")
    assert bool((bond >= 0).all())
    assert torch.allclose(bond.sum(-1), total, rtol=1e-14)
    if contact == "linear":
        site = tc.particle_energy(chain, trajectory)
        assert bool((site < 0).any())  # Eq. 33 is negative at places: that is why the other exists
        assert torch.allclose(site.sum(-1), total, rtol=1e-13)
        for at, masses, matrix, u, v in each(chain, trajectory):
            assert total[at].item() == pytest.approx((masses * v**2).sum() / 2 - u @ matrix @ u / 2, rel=1e-13)


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_total_energy_is_conserved(boundary):
    chain, trajectory = moving(30, boundary, times=(0.0, 1.0, 50.0, 5000.0))
    total = tc.total_energy(chain, trajectory)
    assert torch.allclose(total, total[:, :1].expand_as(total), rtol=1e-12, atol=0)


def test_total_energy_is_the_sum_over_modes():
    # Eq. 41, with the velocity's part: E = sum_j (w_j^2 a_j^2 + c_j^2) / 2.
    chain, trajectory = moving(20)
    modes = tc.normal_modes(chain)
    displacement, velocity = (
        torch.einsum("rp,rtp,rpj->rtj", chain.masses, field, modes.shapes)
        for field in (trajectory.displacement, trajectory.velocity)
    )
    swing = modes.frequencies[:, None] * displacement
    energy = (swing.square() + velocity.square()).sum(-1) / 2
    assert torch.allclose(tc.total_energy(chain, trajectory), energy, rtol=1e-13)


def test_center_and_width_of_known_profiles():
    energy = torch.tensor([[1.0, 0, 0, 0], [0, 0, 0, 5], [1, 0, 0, 1], [1, 1, 1, 1]], dtype=torch.float64)
    assert tc.energy_center(energy).tolist() == [1, 4, 2.5, 2.5]
    assert tc.energy_width(energy).tolist() == [0, 0, 2.25, 1.25]
    assert torch.allclose(tc.energy_width(3 * energy), tc.energy_width(energy))


@pytest.fixture(scope="module")
def center_kick():
    n, site = 256, 128
    chain = tc.Chain(torch.ones(n, dtype=torch.float64))
    times = torch.tensor([0.5, 3.0, 20.0, 60.0, 100.0], dtype=torch.float64)
    return chain, tc.evolve(chain, tc.impulse(chain, site), times), times, site


def spreading(t):
    """r^2 of the bond energy on the infinite chain: t^2 / 2 + 1 / 8, reached as J_0(4 t) decays."""
    return t**2 / 2 + (1 - special.j0(4 * t)) / 8


def test_spreading_of_a_center_kick_by_bonds(center_kick):
    chain, trajectory, t, site = center_kick
    energy = tc.particle_energy(chain, trajectory, "bond")
    np.testing.assert_allclose(tc.energy_center(energy).numpy(), site, rtol=1e-13)
    np.testing.assert_allclose(tc.energy_width(energy).numpy(), spreading(t.numpy()), rtol=1e-10)


def test_spreading_of_a_center_kick_by_sites(center_kick):
    # Summation by parts: r^2 by sites is that by bonds less sum u^2 / v0^2, whose rate is half of int_0^4t J_0: in
    # all t^2 / 2 - t / 2 + 1 / 8 late.
    chain, trajectory, t, _ = center_kick
    t = t.numpy()
    integral = 2 * special.jv(2 * np.arange(400) + 1, 4 * t[:, None]).sum(-1)  # of J_0 from 0 to 4 t
    expected = spreading(t) - t / 2 * (integral - special.j1(4 * t))
    np.testing.assert_allclose(expected[-1], t[-1] ** 2 / 2 - t[-1] / 2 + 1 / 8, atol=0.01)
    expected += 2 * t**2 / chain.n_particles  # displacements count from the ring's mean: mean / 2 * sum F p^2
    energy = tc.particle_energy(chain, trajectory, "site")
    np.testing.assert_allclose(tc.energy_width(energy).numpy(), expected, rtol=1e-9)


@pytest.mark.parametrize("definition", ["bond", "site"])
def test_wave_from_a_kick_beside_a_wall(definition):
    n = 450
    chain = tc.Chain(torch.ones(n, dtype=torch.float64), "fixed")
    t = torch.tensor([100.0, 200.0, 400.0], dtype=torch.float64)
    energy = tc.particle_energy(chain, tc.evolve(chain, tc.impulse(chain, 1), t), definition)
    speed, width = tc.energy_center(energy) / t, tc.energy_width(energy) / t**2
    limit = 32 / (15 * np.pi)
    # Both limits are reached as 1 / t^2.
    assert bool(((speed - limit).abs() < t**-2).all())
    assert bool(((width - (0.5 - limit**2)).abs() < t**-2).all())


@pytest.mark.parametrize(
    ("energy", "error", "message"),
    [
        (torch.zeros(2, 3, 4), FieldError, "total energy must be positive and finite, got 0 at realization 1, time 1"),
        (torch.tensor([[1.0, 1.0], [1.0, -1.0]]), FieldError, "total energy must be positive.*, got 0 at time 2"),
        (torch.tensor([[1.0, float("nan")]]), FieldError, "energy must be finite, got nan"),
        (torch.tensor([[1.0, float("inf")]]), FieldError, "energy must be finite, got inf"),
        (torch.tensor([[1e308, 1e308]], dtype=torch.float64), FieldError, "total energy must be positive and finite"),
        (torch.tensor(1.0), FieldError, "energy must have particles on its last axis"),
        ("abc", FieldTypeError, "energy must be real numbers"),
        (torch.ones(2, dtype=torch.complex64), FieldTypeError, "energy must be real"),
    ],
)
def test_bad_energies(energy, error, message):
    for call in (tc.energy_center, tc.energy_width):
        with pytest.raises(error, match=message):
            call(energy)


def test_lists_are_energies_too():
    assert tc.energy_center([[0, 2, 2]]).tolist() == [2.5]


def test_hertz_chains_have_bond_energy_alone():
    chain, trajectory = moving(contact="hertz")
    for call in (
        lambda: tc.particle_energy(chain, trajectory),
        lambda: tc.potential_energy(chain, trajectory, "site"),
        lambda: tc.energy_matrices(chain, trajectory),
    ):
        with pytest.raises(FieldError, match="contact must be 'linear' here.*definition 'bond'.*'hertz'"):
            call()


def test_unknown_definition():
    chain, trajectory = moving()
    with pytest.raises(FieldError, match="definition must be one of site, bond, got 'both'"):
        tc.particle_energy(chain, trajectory, "both")
