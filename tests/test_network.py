"""Networks, lattices and packings: forces, modes, closed forms from outside, bad input."""

import math
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import network as nw
from torchchain.checks import FieldError, FieldTypeError
from torchchain.network.lattices import PRIMITIVE, grid_wavevectors
from torchchain.network.modes import _negative_pivots

F64 = torch.float64
LATTICES = {"chain": (7,), "square": (4, 5), "triangular": (4, 5), "cubic": (3, 4, 3), "fcc": (3, 4, 3)}
BOUNDARIES = ("periodic", "fixed", "free")


def random_network(batch=(2,), motion="vector", tension=True, seed=0):
    """A small irregular network in the plane with anchors, disorder and prestress."""
    g = torch.Generator().manual_seed(seed)
    x = torch.rand(9, 2, generator=g, dtype=F64) * 3
    anchors = torch.tensor([[-1.0, -1.0], [4.0, 4.0]], dtype=F64)
    pairs = [(i, j) for i in range(9) for j in range(i) if (i + 2 * j) % 3 == 0] + [(0, 9), (5, 10), (3, 9)]
    bonds = torch.tensor(pairs)
    stiffness = 0.5 + torch.rand(*batch, len(pairs), generator=g, dtype=F64)
    pull = 0.2 * torch.rand(len(pairs), generator=g, dtype=F64) if tension and motion == "vector" else 0.0
    masses = 0.5 + torch.rand(*batch, 9, generator=g, dtype=F64)
    return tc.network.Network(masses, x, bonds, stiffness, pull, anchors=anchors, motion=motion)


@pytest.mark.parametrize("motion", ["vector", "scalar"])
def test_force_is_incidence_stiffness_incidence(motion):
    network = random_network(motion=motion)
    c, n = network.n_components, network.n_particles
    incidence = np.zeros((network.n_bonds, c, n + network.n_anchors, c))
    for b, (i, j) in enumerate(network.bonds.tolist()):
        incidence[b, :, j], incidence[b, :, i] = np.eye(c), -np.eye(c)
    incidence = incidence[:, :, :n].reshape(network.n_bonds * c, n * c)
    u = torch.randn(2, 3, n, c, generator=torch.Generator().manual_seed(1), dtype=F64)
    for member in range(2):
        blocks = network.bond_matrices().expand(2, -1, -1, -1)[member].numpy()
        matrix = incidence.T @ np.einsum("bij,bjk->bik", blocks, incidence.reshape(-1, c, n * c)).reshape(-1, n * c)
        np.testing.assert_allclose(network.stiffness_matrix()[member], matrix, atol=1e-13)
        np.testing.assert_allclose(network.sparse_stiffness((member,)).toarray(), matrix, atol=1e-13)
        force = -(u[member].reshape(3, -1).numpy() @ matrix).reshape(3, n, c)
        np.testing.assert_allclose(network.force(u)[member], force, atol=1e-12)
        assert np.linalg.eigvalsh(matrix).min() > -1e-13


def test_prestress_is_the_second_derivative_of_the_energy_of_stretched_springs():
    # Three springs of rest length shorter than their bonds hold a particle: K against automatic differentiation.
    ends = torch.tensor([[1.0, 0.2], [-0.5, 1.0], [-0.4, -1.1]], dtype=F64)
    rest, k = torch.tensor([0.8, 0.7, 1.3], dtype=F64), torch.tensor([1.0, 2.0, 1.5], dtype=F64)

    def energy(x):
        return (k * ((ends - x).norm(dim=-1) - rest).square()).sum() / 2

    hessian = torch.func.hessian(energy)(torch.zeros(2, dtype=F64))
    tension = k * (ends.norm(dim=-1) - rest)
    held = nw.Network(
        torch.ones(1, dtype=F64), torch.zeros(1, 2, dtype=F64), [[0, 1], [0, 2], [0, 3]], k, tension, anchors=ends
    )
    torch.testing.assert_close(held.stiffness_matrix(), hessian, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("motion", ["vector", "scalar"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("kind", LATTICES)
def test_bound_holds_and_counts_fit(kind, boundary, motion):
    network = nw.disordered(
        nw.lattice(kind, LATTICES[kind], motion, boundary), tc.Disorder(strength=0.3), tc.Disorder(strength=0.3), 2, 1
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", nw.FloppyWarning)
        modes = nw.normal_modes(network)
    assert modes.frequencies.shape == (
        2,
        math.prod(LATTICES[kind]) * (len(LATTICES[kind]) if motion == "vector" else 1),
    )
    top = modes.frequencies[:, -1].square()
    assert bool((network.squared_frequency_bound() >= top).all())
    assert bool((network.squared_frequency_bound() <= 2 * top).all())
    gram = torch.einsum("rpcm,rp,rpcn->rmn", modes.shapes, network.masses, modes.shapes)
    torch.testing.assert_close(gram, torch.eye(gram.shape[-1], dtype=F64).expand_as(gram), atol=1e-11, rtol=0)


@pytest.mark.parametrize("motion", ["vector", "scalar"])
@pytest.mark.parametrize("kind", LATTICES)
def test_modes_of_ordered_lattices_are_the_dispersion_relation(kind, motion):
    network = nw.lattice(kind, LATTICES[kind], motion)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", nw.FloppyWarning)
        measured = nw.normal_modes(network).frequencies
    expected = nw.dispersion(network, torch.from_numpy(grid_wavevectors(network))).flatten().sort().values
    torch.testing.assert_close(measured, expected, atol=1e-10, rtol=0)


def frequencies_along(kind, n, turns, motion="vector", tension=0.0):
    """Frequencies of the modes of a ring of n cells along each axis that lie on one wavevector: Bloch's theorem by projection."""
    network = replace(nw.lattice(kind, (n,) * len(PRIMITIVE[kind]), motion), tension=tension)
    sites = torch.cartesian_prod(*[torch.arange(n)] * len(PRIMITIVE[kind])).reshape(network.n_particles, -1)
    phase = 2 * math.pi * (sites * torch.tensor(turns)).sum(-1).to(F64) / n
    wave = torch.exp(1j * phase) / network.n_particles**0.5
    c = network.n_components
    matrix = torch.zeros(c, c, dtype=torch.complex128)
    for a in range(c):
        field = torch.zeros(2, network.n_particles, c, dtype=F64)
        field[0, :, a], field[1, :, a] = wave.real, wave.imag
        image = -network.force(field)
        matrix[:, a] = (wave.conj()[:, None] * (image[0] + 1j * image[1])).sum(0)
    return torch.linalg.eigvalsh(matrix)


def test_triangular_lattice_against_closed_forms():
    n = 12
    for m in range(1, n):
        q = 2 * math.pi * m / n
        # q along a bond: q . a1 = q, q . a2 = q / 2, which fits the ring for even turns.
        measured = frequencies_along("triangular", 2 * n, (2 * m, m))
        expected = sorted([3 - 2 * math.cos(q) - math.cos(q / 2), 3 * (1 - math.cos(q / 2))])
        np.testing.assert_allclose(measured, expected, atol=1e-10)
    np.testing.assert_allclose(frequencies_along("triangular", 12, (6, 0)), [2, 6], atol=1e-10)  # M
    np.testing.assert_allclose(frequencies_along("triangular", 12, (4, 8)), [4.5, 4.5], atol=1e-10)  # K
    q = 1e-3
    lattice = nw.lattice("triangular", (3, 3))
    slow, fast = (nw.dispersion(lattice, torch.tensor([q, 0.0], dtype=F64)) / q).square().tolist()
    assert abs(slow - 3 / 8) < 1e-6
    assert abs(fast - 9 / 8) < 1e-6


def test_square_and_fcc_lattices_against_closed_forms():
    for m in ((1, 0), (3, 2), (5, 5), (4, 1)):
        qx, qy = (2 * math.pi * k / 10 for k in m)
        measured = frequencies_along("square", 10, m, "scalar")
        np.testing.assert_allclose(measured, [4 - 2 * math.cos(qx) - 2 * math.cos(qy)], atol=1e-10)
    for m in range(1, 8):
        # q along [100] has q . a1 = 0 and q . a2 = q . a3 = q / sqrt(2).
        measured = frequencies_along("fcc", 8, (0, m, m))
        fast = 4 * (1 - math.cos(2 * math.pi * m / 8))
        np.testing.assert_allclose(measured, [fast / 2, fast / 2, fast], atol=1e-10)


def test_stretched_chain_in_the_plane():
    # A string under tension: w_T^2 = 4 (T / L) sin^2(q / 2), w_L^2 = 4 k sin^2(q / 2).
    n, pull = 8, 0.3
    x = torch.stack([torch.arange(n, dtype=F64), torch.zeros(n, dtype=F64)], dim=1)
    bonds = torch.tensor([[i, (i + 1) % n] for i in range(n)])
    string = nw.Network(torch.ones(n, dtype=F64), x, bonds, tension=pull, box=torch.tensor([float(n), math.inf]))
    sine = 2 * torch.sin(math.pi * torch.arange(n, dtype=F64) / n)
    expected = torch.cat([sine, pull**0.5 * sine]).sort().values
    torch.testing.assert_close(nw.normal_modes(string).frequencies, expected, atol=1e-10, rtol=0)
    with pytest.raises(nw.UnstableError, match=r"tension must leave .* got -0\.4"):
        nw.normal_modes(replace(string, tension=-0.1))
    with pytest.raises(nw.UnstableError, match=r"got -0\.4"):
        nw.check_stability(replace(string, tension=-0.1))


def test_negative_pivots_count_negative_eigenvalues(monkeypatch):
    lattice = replace(nw.lattice("triangular", (7, 6)), tension=-0.1)
    squared = torch.linalg.eigvalsh(lattice.stiffness_matrix())
    negative = int((squared < -1e-6).sum())
    matrix = lattice.sparse_stiffness().tocsc()
    matrix.setdiag(matrix.diagonal() + 1e-6)
    assert _negative_pivots(matrix) == negative
    monkeypatch.setattr("torchchain.network.modes.MOST_DENSE", 10)
    if negative:
        with pytest.raises(nw.UnstableError, match=f"{squared[0].item():.2f}"):
            nw.check_stability(lattice)
    nw.check_stability(nw.lattice("triangular", (7, 6)))


def test_zero_modes_are_counted_and_told():
    with pytest.warns(
        nw.FloppyWarning, match="has 9 zero modes, 2 of them rigid motions of the whole; 1 connected piece"
    ):
        nw.normal_modes(nw.lattice("square", (4, 5)))
    triangle = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.8]], dtype=F64)
    free = nw.Network(torch.ones(3, dtype=F64), triangle, [[0, 1], [1, 2], [2, 0]])
    assert nw.softness(free).zero_modes == nw.rigid_motions(free) == 3
    two = nw.Network(
        torch.ones(5, dtype=F64), torch.cat([triangle, triangle[:2] + 3]), [[0, 1], [1, 2], [2, 0], [3, 4]]
    )
    soft = nw.softness(two)
    assert (soft.zero_modes, soft.rigid, soft.components, soft.floppy) == (6, 3, 2, 3)
    ball = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=F64)
    tetrahedron = nw.Network(torch.ones(4, dtype=F64), ball, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    assert nw.softness(tetrahedron).zero_modes == nw.rigid_motions(tetrahedron) == 6
    assert nw.rigid_motions(nw.lattice("triangular", (3, 3), boundary="fixed")) == 0


@pytest.mark.filterwarnings("ignore::torchchain.network.FloppyWarning")
def test_gradient_of_a_frequency():
    network = random_network(batch=())

    def highest(masses, stiffness):
        return nw.normal_modes(replace(network, masses=masses, stiffness=stiffness)).frequencies[-3:]

    args = [x.detach().clone().requires_grad_() for x in (network.masses, network.bond_stiffness)]
    assert torch.autograd.gradcheck(highest, args)


X = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 0.8]], dtype=F64)
ONES = torch.ones(3, dtype=F64)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: nw.Network(ONES, X, [[0, 1], [2, 2]]), "bonds must join two different particles, got 2 and 2 at bond 2"),
        (lambda: nw.Network(ONES, X, [[0, 1], [1, 0]]), "bonds must differ from each other, got 1 and 0 at bonds 1 and 2"),
        (lambda: nw.Network(ONES, X, [[0, 3]]), "bonds must join particles 0 to 2, got 0 and 3 at bond 1"),
        (lambda: nw.Network(ONES, X, [[0, 3]], anchors=X[:1]), "length of bonds must be positive, got 0 at bond 1"),
        (lambda: nw.Network(ONES, X, [[3, 4]], anchors=X[:2]), "bonds must have a particle at one end at least"),
        (lambda: nw.Network(ONES, X, [[0, 1]], box=torch.tensor([2.0, 9.0])), "be less than half the box, 1, where"),
        (lambda: nw.Network(ONES, X, [[0, 1]], box=torch.tensor([-1.0, 9.0])), "box must be positive"),
        (lambda: nw.Network(ONES, X, [[0, 1]], box=torch.ones(3)), "box must have shape"),
        (lambda: nw.Network(ONES, X, [[0, 1]], box=torch.ones(2, 2)), "box must have rows that span a volume"),
        (lambda: nw.Network(-ONES, X, [[0, 1]]), "masses must be positive, got -1 at particle 1"),
        (lambda: nw.Network(ONES, X[:2], [[0, 1]]), "positions must have shape"),
        (lambda: nw.Network(ONES, X, [[0, 1]], stiffness=-1.0), "stiffness must not be negative"),
        (lambda: nw.Network(ONES, X, [[0, 1]], stiffness=torch.ones(4)), "stiffness must be a number or have shape"),
        (lambda: nw.Network(ONES, X, [[0, 1]], tension=0.1, motion="scalar"), "tension must be zero for motion 'scalar'"),
        (lambda: nw.Network(ONES, X, [[0, 1]], motion="tensor"), "motion must be one of vector, scalar"),
        (lambda: nw.lattice("hexagonal", (3, 3)), "kind must be one of chain"),
        (lambda: nw.lattice("square", (3,)), "shape must have 2 entries"),
        (lambda: nw.lattice("square", (2, 3)), "shape must be at least 3 along a periodic axis"),
        (lambda: nw.lattice("square", (3, 3), boundary="open"), "boundary must be one of"),
        (lambda: nw.packing(X, -ONES, ONES), "radii must be positive"),
        (lambda: nw.packing(X, ONES[:2], ONES), "radii must have shape"),
        (lambda: nw.packing(X, ONES, ONES, contact="glue"), "contact must be one of linear, hertz"),
        (lambda: nw.packing(torch.zeros(3, 2, dtype=F64), ONES, ONES), "length of bonds must be positive"),
        (lambda: nw.diluted(nw.lattice("square", (3, 3)), 1.5), "fraction must be at most 1"),
        (lambda: nw.mixture(4, (1.0, 2.0), (0.5, 0.6)), "fractions must be one for each value"),
        (lambda: nw.dispersion(nw.lattice("square", (3, 3), boundary="fixed"), torch.zeros(2)), "be a periodic lattice"),
        (lambda: nw.plane_wave(nw.lattice("square", (4, 4), "scalar"), (2, 0), "scalar"), "a sine that vanishes"),
        (lambda: nw.band_waves(nw.lattice("square", (4, 4), "scalar"), 9), "leave a wave inside the zone for every shell"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(make, words):
    with pytest.raises(FieldError) as caught:
        make()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_wrong_types():
    with pytest.raises(FieldTypeError, match="bonds must be integers"):
        nw.Network(ONES, X, [[0.0, 1.0]])
    with pytest.raises(FieldTypeError, match="box must be None or have shape"):
        nw.Network(ONES, X, [[0, 1]], box=3.0)
    with pytest.raises(FieldTypeError, match="shape must be 2 integers"):
        nw.lattice("square", 5)


def test_disorder_of_a_realization_does_not_depend_on_the_others():
    lattice = nw.lattice("triangular", (4, 4))
    both = {"masses": tc.Disorder(strength=0.2), "stiffness": tc.Disorder(strength=0.2), "seed": 5}
    many = nw.disordered(lattice, **both, realizations=4)
    one = nw.disordered(lattice, **both, realizations=[2])
    assert torch.equal(many.masses[2:3], one.masses)
    assert torch.equal(many.stiffness[2:3], one.stiffness)
    assert torch.equal(one.masses[0], tc.Disorder(strength=0.2).masses(16, [2], 5)[0])
    thin = nw.diluted(lattice, 0.3, 50, seed=1)
    assert torch.equal(thin.stiffness[7], nw.diluted(lattice, 0.3, [7], seed=1).stiffness[0])
    removed = (thin.stiffness == 0).double().mean().item()
    assert abs(removed - 0.3) < 5 * (0.3 * 0.7 / thin.stiffness.numel()) ** 0.5
    moved = nw.displaced(lattice, 0.05, realization=3, seed=2)
    assert torch.equal(moved.positions, nw.displaced(lattice, 0.05, realization=3, seed=2).positions)
    assert not torch.equal(moved.positions, nw.displaced(lattice, 0.05, realization=4, seed=2).positions)
    mixed = nw.mixture(10, (1.0, 1.4), (0.5, 0.5), 3)
    assert torch.equal(mixed.sort(-1).values, torch.tensor([[1.0] * 5 + [1.4] * 5] * 3, dtype=F64))
    assert torch.equal(mixed[1], nw.mixture(10, (1.0, 1.4), (0.5, 0.5), [1])[0])


def test_a_removed_bond_and_a_bond_of_no_stiffness_are_the_same():
    lattice = nw.lattice("triangular", (4, 4))
    keep = torch.ones(lattice.n_bonds, dtype=torch.bool)
    keep[::5] = False
    soft = replace(lattice, stiffness=keep.to(F64))
    torch.testing.assert_close(soft.stiffness_matrix(), lattice.with_bonds(keep).stiffness_matrix(), rtol=0, atol=1e-14)
