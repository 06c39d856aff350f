"""Networks in time: methods against each other, conservation, gradients, grains against LAMMPS."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import network as nw
from torchchain.checks import FieldError
from torchchain.network import chebyshev, kernels, layouts

F64 = torch.float64
TIMES = torch.tensor([0.0, 0.3, 1.0, 2.5, 30.0, 200.0], dtype=F64)
LATTICES = {"chain": (7,), "square": (4, 5), "triangular": (4, 5), "cubic": (3, 4, 3), "fcc": (3, 4, 3)}
DATA = Path(__file__).parent / "data" / "packing_lammps.npz"

pytestmark = pytest.mark.filterwarnings("ignore::torchchain.network.FloppyWarning")


def random_state(network, members=(2,), seed=1):
    g = torch.Generator().manual_seed(seed)
    shape = (*network.batch_shape, *members, network.n_particles, network.n_components)
    u, v = (torch.randn(shape, generator=g, dtype=F64) for _ in range(2))
    mass = network.align(network.masses, v)  # at rest as a whole, which would drift far
    return tc.State(u, v - (mass * v).sum(-2, keepdim=True) / mass.sum(-2, keepdim=True))


def plain(network):
    """The same network without what is known of its lattice."""
    fields = ("masses", "positions", "bonds", "stiffness", "tension", "box", "motion", "damping", "anchors", "images")
    return nw.Network(**{name: getattr(network, name) for name in fields})


def disordered(kind, motion="vector", boundary="periodic"):
    ordered = nw.lattice(kind, LATTICES[kind], motion, boundary)
    return nw.disordered(ordered, tc.Disorder(strength=0.2), tc.Disorder(strength=0.2), 2, 3)


def far(a, b):
    return max((a.displacement - b.displacement).abs().max().item(), (a.velocity - b.velocity).abs().max().item())


@pytest.fixture(autouse=True)
def rows_of_any_length(monkeypatch):
    """Lattices of these sizes would otherwise be gathered, as the plain networks are that stand beside them here."""
    monkeypatch.setattr(layouts, "NARROW", 0)


@pytest.mark.parametrize(
    ("kind", "motion", "boundary", "tension", "disorder"),
    [
        ("chain", "vector", "fixed", 0.0, True),
        ("square", "scalar", "periodic", 0.0, False),
        ("square", "vector", "free", 0.1, True),
        ("triangular", "vector", "periodic", 0.0, False),
        ("triangular", "vector", "periodic", 0.1, False),
        ("triangular", "vector", ("fixed", "periodic"), 0.0, True),
        ("triangular", "scalar", ("free", "periodic"), 0.0, True),
        ("cubic", "vector", "fixed", 0.2, True),
        ("fcc", "vector", "periodic", 0.0, True),
        ("fcc", "vector", ("periodic", "free", "fixed"), 0.1, False),
        ("fcc", "scalar", "periodic", 0.0, False),
    ],
)
def test_chebyshev_is_the_sum_over_modes(kind, motion, boundary, tension, disorder):
    network = disordered(kind, motion, boundary) if disorder else nw.lattice(kind, LATTICES[kind], motion, boundary)
    network = replace(network, tension=tension)
    state = random_state(network)
    exact = nw.evolve(network, state, TIMES)
    # The states are of size 1 to 4, in modes of w t up to 800: rounding of w t, hundreds of sums.
    assert far(exact, nw.evolve(network, state, TIMES, "chebyshev")) < 1e-10
    assert far(exact, nw.evolve(network, state, TIMES, "chebyshev", compiled=False)) < 1e-10
    assert far(exact, nw.evolve(plain(network), state, TIMES, "chebyshev")) < 1e-10


def test_layouts(monkeypatch):
    def kind(network):
        return type(layouts.layout_of(network)).__name__

    straight, moved = nw.lattice("square", (3, 3)), nw.displaced(nw.lattice("square", (3, 3)), 0.01)
    assert (kind(straight), kind(moved)) == ("Rows", "Gathered")
    monkeypatch.setattr(layouts, "NARROW", 4)
    assert kind(straight) == "Gathered"


def test_renumbering_leaves_the_particles_in_place(monkeypatch):
    network = plain(disordered("triangular"))
    state = random_state(network)
    before = nw.evolve(network, state, TIMES, "chebyshev")
    monkeypatch.setattr(layouts, "RENUMBER", 0)
    assert not np.array_equal(layouts.Gathered(network).order, np.arange(network.n_particles))
    phase = float(network.squared_frequency_bound().max().sqrt() * TIMES[-1])
    size = float(before.displacement.abs().max() + before.velocity.abs().max())
    rounding = 20 * phase * torch.finfo(torch.float64).eps * size  # an exact method errs by some w t eps of the state
    assert far(before, nw.evolve(network, state, TIMES, "chebyshev")) < rounding


@pytest.mark.parametrize("motion", nw.networks.MOTIONS)
def test_steps_of_one_sweep_are_those_made_one_by_one(motion, monkeypatch):
    monkeypatch.setattr(layouts, "TILE", layouts.WINDOW)
    monkeypatch.setattr(layouts, "RENUMBER", 0)
    grid = nw.displaced(nw.lattice("square", (36, 36)), 0.3, seed=3)  # particles with none to many neighbors
    radii = torch.full((grid.n_particles,), 0.62, dtype=torch.float64)
    disks = tc.packing(grid.positions, radii, grid.masses, [36.0, 36.0], prestress=False)
    network = replace(disks, motion=motion)
    state = random_state(network)
    swept = layouts.Gathered(network)
    assert swept.depth > 2
    assert swept.lag > 1
    assert swept.parts > 2 * swept.lag
    together = nw.evolve(network, state, [5.0], "chebyshev")
    monkeypatch.setattr(layouts, "SWEPT", 0.0)
    assert layouts.Gathered(network).depth == 1
    apart = nw.evolve(network, state, [5.0], "chebyshev")
    assert torch.equal(together.displacement, apart.displacement)
    assert torch.equal(together.velocity, apart.velocity)
    assert far(together, nw.evolve(network, state, [5.0], "chebyshev", compiled=False)) < 1e-10


@pytest.mark.parametrize("lattice", [True, False])
def test_threads_share_a_network_and_change_no_bit(lattice, monkeypatch):
    network = disordered("triangular") if lattice else plain(disordered("triangular"))
    state = random_state(network)
    alone = nw.evolve(network, state, TIMES, "chebyshev")
    monkeypatch.setattr(chebyshev, "SPLIT", 0)
    threads = torch.get_num_threads()
    try:
        for count in (3, 7):  # each thread has states of its own; all threads work on one of four
            torch.set_num_threads(count)
            shared = nw.evolve(network, state, TIMES, "chebyshev")
            assert torch.equal(alone.displacement, shared.displacement)
            assert torch.equal(alone.velocity, shared.velocity)
    finally:
        torch.set_num_threads(threads)


def test_windows_of_times_and_members_of_a_batch_stand_alone():
    network = disordered("fcc")
    state = random_state(network)
    whole = nw.evolve(network, state, TIMES, "chebyshev")
    advance = nw.begin(network, state, "chebyshev")
    parts = [advance(TIMES[:4]), advance(TIMES[4:])]
    assert (
        far(parts[1], nw.NetworkTrajectory(TIMES[4:], whole.displacement[..., 4:, :, :], whole.velocity[..., 4:, :, :]))
        < 1e-11
    )
    one = replace(network, masses=network.masses[1], stiffness=network.stiffness[1])
    alone = nw.evolve(one, tc.State(state.displacement[1, 0], state.velocity[1, 0]), TIMES, "chebyshev")
    assert torch.equal(alone.displacement, whole.displacement[1, 0])
    assert torch.equal(alone.final.velocity, whole.final.velocity[1, 0])
    with pytest.raises(FieldError, match="times must not go back"):
        advance(TIMES[:2])


def test_energy_momentum_and_reciprocity_of_a_large_lattice():
    network = nw.disordered(nw.lattice("triangular", (60, 70)), tc.Disorder(strength=0.3), realizations=1, seed=2)
    n = network.n_particles
    kicks = torch.zeros(1, 2, n, 2, dtype=F64)
    kicks[0, 0, 100, 0], kicks[0, 1, 900, 1] = 1 / network.masses[0, 100], 1 / network.masses[0, 900]
    path = nw.evolve(network, tc.State(torch.zeros_like(kicks), kicks), [5.0, 40.0], "chebyshev")
    energy = nw.total_energy(network, path)
    torch.testing.assert_close(energy[0, 0], (0.5 / network.masses[0, 100]).expand(2), rtol=1e-12, atol=0)
    momentum = (network.align(network.masses, path.velocity) * path.velocity).sum(-2)
    torch.testing.assert_close(momentum[0, 0, 1], torch.tensor([1.0, 0.0], dtype=F64), rtol=0, atol=1e-12)
    # What an impulse on one particle does to another is what the same impulse there does here.
    u = path.displacement[0, :, 1]
    assert abs(u[0, 900, 1] - u[1, 100, 0]) < 1e-12
    assert u[0, 900, 1].abs() > 1e-6


def test_a_bound_that_is_too_small_is_refused():
    network = disordered("triangular")
    state = random_state(network)
    top = nw.normal_modes(network).frequencies[:, -1].square()
    tight = nw.evolve(network, state, TIMES, "chebyshev", bound=top * (1 + 1e-9))
    assert far(tight, nw.evolve(network, state, TIMES)) < 1e-10
    with pytest.raises(FieldError, match=r"bound must not lie below the largest squared frequency .* at network 2"):
        nw.evolve(network, state, TIMES, "chebyshev", bound=top * torch.tensor([1.1, 0.999]))
    with pytest.raises(FieldError, match="times must be at most"):
        nw.evolve(network, state, [1e12], "chebyshev")
    with pytest.raises(FieldError, match="rounding in float64 has blurred the phases"):
        nw.evolve(network, state, [1e15])


def test_gradients_of_masses_stiffness_and_positions():
    base = nw.lattice("triangular", (3, 3), boundary="fixed")
    state = random_state(base, ())

    def final(masses, stiffness, positions):
        network = replace(base, masses=masses, stiffness=stiffness, positions=positions)
        return nw.evolve(network, state, [1.5], "chebyshev").displacement

    args = (base.masses, base.bond_stiffness, base.positions)
    args = [x.detach().clone().requires_grad_() for x in args]
    assert torch.autograd.gradcheck(final, args)


@pytest.mark.parametrize("method", list(nw.METHODS))
def test_dtype_is_kept_and_input_left_alone(method):
    network = nw.lattice("triangular", (3, 4))
    network = replace(network, masses=network.masses.float(), positions=network.positions.float())
    state = random_state(network)
    state = tc.State(state.displacement.float(), state.velocity.float())
    before = state.displacement.clone()
    path = nw.evolve(network, state, TIMES[:4], method)
    assert path.displacement.dtype == torch.float32
    assert path.displacement.shape == (2, 4, 12, 2)
    assert torch.equal(before, state.displacement)
    torch.testing.assert_close(path.displacement[:, 0], state.displacement, rtol=1e-5, atol=1e-5)


def test_verlet_is_of_second_order():
    network = disordered("triangular")
    state = random_state(network, ())
    exact = nw.evolve(network, state, [10.0])
    errors = [far(exact, nw.evolve(network, state, [10.0], "verlet", step=h)) for h in (0.04, 0.02, 0.01)]
    assert 3.8 < errors[0] / errors[1] < 4.2
    assert 3.9 < errors[1] / errors[2] < 4.1
    with pytest.raises(FieldError, match="step must be less than"):
        nw.evolve(network, state, [1.0], "verlet", step=5.0)


def test_damped_motion_by_exponentials_and_by_verlet():
    network = replace(disordered("triangular"), damping=0.1)
    state = random_state(network, ())
    times = torch.tensor([0.0, 0.5, 1.0, 5.0, 300.0], dtype=F64)
    exact = nw.evolve(network, state, times, "damped")
    coarse, fine = (nw.evolve(network, state, times[:4], "verlet", step=h) for h in (0.01, 0.005))
    exact_part = nw.NetworkTrajectory(times[:4], exact.displacement[..., :4, :, :], exact.velocity[..., :4, :, :])
    assert 3.8 < far(exact_part, coarse) / far(exact_part, fine) < 4.2
    energy = nw.total_energy(network, exact)
    torch.testing.assert_close(energy + exact.dissipated, energy[:, :1].expand_as(energy), rtol=1e-10, atol=1e-10)
    assert bool((exact.dissipated.diff(dim=-1) > 0).all())
    assert bool((energy[:, -1] < 1e-6 * energy[:, 0]).all())
    undamped = replace(network, damping=0.0)
    assert far(nw.evolve(undamped, state, times, "damped"), nw.evolve(undamped, state, times)) < 1e-9
    with pytest.raises(
        FieldError, match=r"damping must be zero for method 'chebyshev' \(methods with damping: verlet, damped\)"
    ):
        nw.evolve(network, state, times, "chebyshev")


def test_states_of_another_shape_are_refused():
    network = nw.lattice("triangular", (3, 3))
    for shape in ((9,), (8, 2), (9, 3)):
        with pytest.raises(FieldError, match=r"state must have shape \(\*batch, 9, 2\)"):
            nw.evolve(network, tc.State(torch.zeros(shape), torch.zeros(shape)), [1.0])


# packings


@pytest.fixture(scope="module")
def lammps():
    """A jammed packing of 48 disks by LAMMPS with its own numbers; tests/data/packing_lammps.py makes it."""
    with np.load(DATA) as file:
        data = {name: torch.from_numpy(file[name]) for name in file.files}
    packing = nw.packing(data["positions"], data["radii"], torch.ones(len(data["radii"]), dtype=F64), data["box"])
    return packing, data


def test_frequencies_of_a_packing_are_those_of_lammps(lammps):
    packing, data = lammps
    modes = nw.normal_modes(packing)
    matrix = (data["matrix"] + data["matrix"].mT) / 2
    theirs = torch.linalg.eigvalsh(matrix).clamp(min=0).sqrt()
    loose = int(nw.rattlers(packing).sum())
    assert loose == 2
    assert int(modes.n_zero) == 2 + 2 * loose
    zero = int(modes.n_zero)
    torch.testing.assert_close(modes.frequencies[zero:], theirs[zero:], rtol=1e-6, atol=0)
    # LAMMPS takes differences of forces over 1e-6, which leaves some 1e-9.
    torch.testing.assert_close(packing.stiffness_matrix(), data["matrix"], rtol=0, atol=1e-7)
    held = nw.normal_modes(nw.without_rattlers(packing))
    assert int(held.n_zero) == 2
    torch.testing.assert_close(held.frequencies[2:], modes.frequencies[zero:], rtol=1e-9, atol=0)


def test_a_kick_in_a_packing_goes_as_in_lammps(lammps):
    packing, data = lammps
    state = tc.State(torch.zeros_like(data["kick"]), data["kick"])
    path = nw.evolve(packing, state, data["times"], "verlet", step=float(data["step"]))
    size = float(data["kick"].abs().max())
    assert data["displacement"][-1].abs().max() > 3 * size
    assert (path.displacement - data["displacement"]).abs().max() < 1e-6 * size
    assert (path.velocity[-1] - data["velocity"]).abs().max() < 1e-6 * size
    linear = nw.evolve(packing, state, data["times"], "chebyshev")
    moved = (linear.displacement - path.displacement)[:, ~nw.rattlers(packing)]
    assert moved.abs().max() < 1e-2 * size  # the contact law is linear, but contacts turn


def test_prestress_is_felt(lammps):
    _, data = lammps
    loose = nw.packing(data["positions"], data["radii"], torch.ones(48, dtype=F64), data["box"], prestress=False)
    assert not loose.is_prestressed
    assert (loose.stiffness_matrix() - data["matrix"]).abs().max() > 1e-3


@pytest.mark.parametrize("contact", ["linear", "hertz"])
def test_forces_between_grains_are_the_gradient_of_their_energy(contact):
    g = torch.Generator().manual_seed(4)
    lattice = nw.displaced(nw.lattice("triangular", (4, 4)), 0.02, seed=1)
    packing = nw.packing(
        lattice.positions, torch.full((16,), 0.54, dtype=F64), torch.ones(16, dtype=F64), lattice.box, 2.0, contact
    )
    moved = (0.02 * torch.randn(1, 16, 2, generator=g, dtype=F64)).requires_grad_()
    energy = nw.grain_energy(packing, nw.NetworkTrajectory(torch.zeros(1), moved, torch.zeros_like(moved))).sum()
    expected = -torch.autograd.grad(energy, moved)[0][0]
    force = np.empty((16, 2))
    shifts = (packing.images.double() @ packing.box).numpy()
    x = packing.positions.numpy() + moved.detach()[0].numpy()
    kernels.grain_force(
        x, packing.radii.numpy(), packing.bonds.numpy(), shifts, contact == "hertz", 2.0, 0.0, np.zeros((16, 2)), force
    )
    np.testing.assert_allclose(force, expected, atol=1e-13)


@pytest.mark.parametrize("contact", ["linear", "hertz"])
def test_small_motion_of_grains_is_the_networks(contact):
    lattice = nw.lattice("triangular", (5, 6))
    packing = nw.packing(
        lattice.positions, torch.full((30,), 0.51, dtype=F64), torch.ones(30, dtype=F64), lattice.box, 1.0, contact
    )
    assert packing.n_contacts == 90
    state = random_state(packing, ())
    errors = []
    for size in (1e-5, 1e-6):
        small = tc.State(size * state.displacement, size * state.velocity)
        grains = nw.evolve(packing, small, [5.0], "verlet", step=0.002)
        network = nw.evolve(packing, small, [5.0], "verlet", step=0.002, linear=True)
        errors.append(far(grains, network) / size)
    assert 8 < errors[0] / errors[1] < 12  # what the linear motion leaves out is of second order
    assert errors[1] < 1e-3


def test_grains_collide_part_and_keep_energy_and_momentum():
    # Two balls in free flight: contact for half a period of their spring, then the exchanged velocities.
    x = torch.tensor([[0.0], [1.5]], dtype=F64)
    pair = nw.packing(x, torch.tensor([0.5, 0.5], dtype=F64), torch.ones(2, dtype=F64))
    assert pair.n_contacts == 0
    state = tc.State(torch.zeros(2, 1, dtype=F64), torch.tensor([[1.0], [0.0]], dtype=F64))
    path = nw.evolve(pair, state, [0.4, 4.0], "verlet", step=1e-3)
    torch.testing.assert_close(
        path.velocity[:, :, 0], torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=F64), rtol=0, atol=1e-5
    )
    # They meet at t = 0.5 and are in contact for pi / sqrt(2); the first has then moved 0.5 and half of that.
    contact = np.pi / 2**0.5
    assert abs(path.displacement[1, 0, 0] - (0.5 + contact / 2)) < 1e-3


def test_openings_are_counted():
    lattice = nw.lattice("triangular", (5, 6))
    packing = nw.packing(lattice.positions, torch.full((30,), 0.51, dtype=F64), torch.ones(30, dtype=F64), lattice.box)
    state = random_state(packing, ())
    path = nw.evolve(
        packing, tc.State(0 * state.displacement, 0.1 * state.velocity), torch.arange(0, 10, 1.0), "verlet"
    )
    assert path.openings[0] == 0
    assert path.openings[-1] > 5
    assert bool((path.openings.diff() >= 0).all())


@pytest.mark.parametrize("skewed", [False, True])
def test_contacts_are_those_of_all_pairs_and_copies(skewed):
    g = torch.Generator().manual_seed(8)
    for d, n in ((2, 15), (3, 20)):
        cell = torch.diag(2.0 + torch.rand(d, generator=g, dtype=F64))
        if skewed:
            cell[1, 0] = 0.9
        x = 5 * torch.rand(n, d, generator=g, dtype=F64) - 1  # also outside of the cell
        radii = 0.3 + 0.3 * torch.rand(n, generator=g, dtype=F64)
        packing = nw.packing(x, radii, torch.ones(n, dtype=F64), cell if skewed else cell.diagonal(), prestress=False)
        found = sorted(packing.lengths.tolist())
        expected = []
        turns = torch.cartesian_prod(*[torch.arange(-6.0, 7.0, dtype=F64)] * d)
        for i in range(n):
            for j in range(i, n):
                length = (x[j] - x[i] + turns @ cell).norm(dim=-1)
                length = length[(length < radii[i] + radii[j]) & (length > 1e-9)]
                expected += length.tolist() if i < j else sorted(length.tolist())[::2]
        np.testing.assert_allclose(found, sorted(expected), atol=1e-12)


def test_rattlers_are_found_recursively():
    # A ring of six around a disk that touches nothing, and one disk hanging on the ring by one contact.
    angle = torch.arange(6, dtype=F64) * np.pi / 3
    ring = torch.stack([angle.cos(), angle.sin()], dim=1)
    x = torch.cat([ring, torch.zeros(1, 2, dtype=F64), torch.tensor([[1.95, 0.0], [2.9, 0.0]], dtype=F64)])
    radii = torch.tensor([0.52] * 6 + [0.2] + [0.5] * 2, dtype=F64)
    packing = nw.packing(x, radii, torch.ones(9, dtype=F64))
    assert packing.n_contacts == 8
    assert bool(nw.rattlers(packing).all())  # disks of the ring have two contacts each, one too few
    assert nw.rattlers(nw.lattice("triangular", (4, 4))).sum() == 0
    chain = nw.Network(torch.ones(3, dtype=F64), [[0.0], [1.0], [2.0]], [[0, 1], [1, 2]])
    assert not bool(nw.rattlers(chain).any())


@pytest.mark.parametrize("boundary", ["periodic", "fixed"])
def test_a_chain_is_the_network_in_one_dimension(boundary):
    masses = tc.Disorder(strength=0.3).masses(24, 2, seed=4)
    chain = tc.Chain(masses, boundary=boundary, damping=0.0)
    network = replace(nw.lattice("chain", (24,), boundary=boundary), masses=masses)
    torch.testing.assert_close(network.stiffness_matrix(), -chain.stiffness_matrix(), rtol=0, atol=0)  # K of Eq. 15 is -A
    w, v = tc.normal_modes(chain).frequencies, tc.normal_modes(network).frequencies
    torch.testing.assert_close(w, v, rtol=0, atol=1e-12)
    state = tc.impulse(chain, site=7)
    lifted = tc.State(state.displacement[..., None], state.velocity[..., None])
    times = [0.0, 2.0, 30.0]
    one = tc.evolve(chain, state, times, "chebyshev")
    two = tc.evolve(network, lifted, times, "chebyshev")
    torch.testing.assert_close(two.displacement[..., 0], one.displacement, rtol=0, atol=1e-12)
    torch.testing.assert_close(two.velocity[..., 0], one.velocity, rtol=0, atol=1e-12)
    for definition in ("site", "bond"):
        energies = (tc.particle_energy(x, path, definition) for x, path in ((chain, one), (network, two)))
        torch.testing.assert_close(*energies, rtol=0, atol=1e-12)
    if boundary == "periodic":
        shares = (tc.band_energy(x, path, 6) for x, path in ((chain, one), (network, two)))
        torch.testing.assert_close(*shares, rtol=0, atol=1e-12)


def test_kernels_are_found_again_by_other_processes():
    """Numba keys what it keeps by what a function closes over: a compiled function there would have another key in every process."""
    kernel = kernels.gathered(2, 1, False, True)
    inside = [cell.cell_contents for cell in kernel.py_func.__closure__]
    assert inside
    assert not any(hasattr(value, "py_func") for value in inside)
