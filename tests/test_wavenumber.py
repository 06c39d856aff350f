import literal
import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError

N, BANDS = 24, 4


def chain_of(kind, realizations=2, n=N):
    """Rings with equal contacts, rings with unequal ones, and fixed chains: three code paths."""
    masses = tc.Disorder("normal", 0.3).masses(n, realizations, 5)
    boundary = "fixed" if kind == "fixed" else "periodic"
    stiffness = 1.0
    if kind == "unequal":
        stiffness = tc.Disorder("uniform", 0.3).stiffnesses(n, realizations, 5)
    return tc.Chain(masses, boundary, stiffness)


def random_state(shape, seed=0):
    u, v = torch.randn(2, *shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return tc.State(u, v)


def still(chain, state):
    """The state without net momentum."""
    drift = (chain.masses * state.velocity).sum(-1, keepdim=True) / chain.masses.sum(-1, keepdim=True)
    return tc.State(state.displacement, state.velocity - drift)


def matrix_of(chain, i):
    return literal.stiffness_matrix(chain.contact_stiffness[i].numpy(), chain.n_particles, chain.boundary)


STATES = {
    "waves": lambda chain: tc.standing_wave(chain, [1, 5, 11]),
    "cosine": lambda chain: tc.standing_wave(chain, [12], phase="cos"),
    "kick": lambda chain: still(chain, tc.impulse(chain, 4)),
}


@pytest.mark.parametrize("start", STATES)
@pytest.mark.parametrize("kind", ["equal", "unequal", "fixed"])
def test_band_energies_are_the_literal_eq_42(kind, start):
    chain = chain_of(kind)
    state = STATES[start](chain)
    times = [0.0, 1.0, 50.0, 5000.0]
    measured = tc.band_energy(chain, tc.evolve(chain, state, times), BANDS)
    displacement = state.displacement.reshape(2, -1, N)
    velocity = state.velocity.reshape(2, -1, N)
    measured = measured.reshape(2, -1, 4, BANDS)
    for i, j in np.ndindex(2, displacement.shape[1]):
        matrix, masses = matrix_of(chain, i), chain.masses[i].numpy()
        u, v = literal.states(masses, matrix, displacement[i, j].numpy(), velocity[i, j].numpy(), times)
        for t in range(4):
            expected = literal.band_energy(masses, matrix, u[t], v[t], BANDS)
            np.testing.assert_allclose(measured[i, j, t].numpy(), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", ["equal", "unequal", "fixed"])
@pytest.mark.parametrize("n", [2, 5, 8])
def test_the_diagonal_is_that_of_the_full_matrix(kind, n):
    chain = chain_of(kind, n=n)
    trajectory = tc.evolve(chain, random_state((2, n)), [0.0, 3.0])
    matrices = tc.energy_matrices(chain, trajectory)
    full = tc.wavenumber_energy_matrix(matrices)
    assert full.shape == (2, 2, n, n)
    measured = tc.wavenumber_energy(chain, trajectory)
    for i, t in np.ndindex(2, 2):
        forward = literal.dft(n)
        total = matrices.total[i, t].numpy()
        np.testing.assert_allclose(full[i, t].numpy(), forward @ total @ forward.conj().T, atol=1e-13)
        expected = literal.wavenumber_energy(total)
        np.testing.assert_allclose(measured[i, t].numpy(), expected.real, atol=1e-13)
        np.testing.assert_allclose(expected.imag, 0, atol=1e-13)


@pytest.mark.parametrize("definition", ["site", "bond"])
@pytest.mark.parametrize("kind", ["equal", "unequal"])
def test_energies_sum_to_the_total(kind, definition):
    chain = chain_of(kind)
    trajectory = tc.evolve(chain, random_state((2, 3, N)), [0.0, 3.0, 700.0])
    energy = tc.wavenumber_energy(chain, trajectory, definition)
    total = tc.total_energy(chain, trajectory)
    assert torch.allclose(energy.sum(-1), total, rtol=1e-13)
    assert torch.allclose(total, total[..., :1].expand_as(total), rtol=1e-12)
    raw = tc.band_energy(chain, trajectory, BANDS, normalize=False, definition=definition)
    shares = tc.band_energy(chain, trajectory, BANDS, definition=definition)
    assert torch.allclose(shares, raw / total[..., None], rtol=1e-13, atol=1e-15)
    if definition == "site":
        rest = tc.zero_wavenumber_share(chain, trajectory)
        assert torch.allclose(shares.sum(-1) + rest, torch.ones_like(rest), rtol=1e-12)


@pytest.mark.parametrize("kind", ["equal", "unequal"])
def test_bond_energies_are_squares(kind):
    chain = chain_of(kind)
    trajectory = tc.evolve(chain, tc.standing_wave(chain, [1, 5, 11]), torch.arange(40.0))
    bond = tc.wavenumber_energy(chain, trajectory, "bond")
    assert bool((bond >= 0).all())
    assert bool((tc.wavenumber_energy(chain, trajectory) < 0).any())  # what Eq. 42 does in single realizations
    forward = literal.dft(N)
    for i, j, t in ((0, 0, 0), (1, 2, 7), (0, 1, 33)):
        u, v = trajectory.displacement[i, j, t].numpy(), trajectory.velocity[i, j, t].numpy()
        moved = forward @ (np.sqrt(chain.masses[i].numpy()) * v)
        stretched = forward @ (np.sqrt(chain.contact_stiffness[i].numpy()) * (u - np.roll(u, 1)))
        per_k = (abs(moved) ** 2 + abs(stretched) ** 2) / 2
        folded = [per_k[0], *(per_k[k] + per_k[N - k] for k in range(1, N // 2)), per_k[N // 2]]
        np.testing.assert_allclose(bond[i, j, t].numpy(), folded, rtol=0, atol=1e-14 * sum(folded))


def test_share_of_zero_wavenumber():
    # A ring moving as a whole: all energy is kinetic; at k = 0 lies the mean of b times the mean of v (M v and v).
    masses = torch.ones(1, 8, dtype=torch.float64)
    ordered = tc.Chain(masses)
    flight = tc.evolve(ordered, tc.State(torch.zeros(1, 8).double(), torch.ones(1, 8).double()), [0.0, 9.0])
    assert torch.allclose(tc.zero_wavenumber_share(ordered, flight), torch.ones(1, 2, dtype=torch.float64))
    chain = chain_of("equal")
    state = tc.impulse(chain, 3)
    share = tc.zero_wavenumber_share(chain, tc.evolve(chain, state, [0.0]))
    assert torch.allclose(share, torch.full((2, 1), 1 / N, dtype=torch.float64), rtol=1e-13)  # a point is in every k
    # and the energy of the drift, which no time changes, is at k = 0 in part only: M v is not uniform in disorder
    both = tc.evolve(chain, tc.standing_wave(chain, 5, 1.0) + tc.State(0 * chain.masses, 1 + 0 * chain.masses), [0.0])
    energy = tc.wavenumber_energy(chain, both)[:, 0, 0]
    assert torch.allclose(energy, chain.masses.sum(-1) / 2, rtol=1e-13)


def test_no_band_ever_loses_energy_without_disorder():
    ordered = tc.Chain(torch.ones(1, N, dtype=torch.float64))
    for phase, tones in (("sin", range(1, N // 2)), ("cos", range(1, N // 2 + 1))):
        for definition in ("site", "bond"):
            state = tc.standing_wave(ordered, list(tones), phase=phase)
            moved = tc.evolve(ordered, state, [0.0, 1.0, 77.7, 1e5])
            share = tc.band_energy(ordered, moved, N // 2, definition=definition)
            expected = torch.zeros(1, len(tones), N // 2, dtype=torch.float64)
            for i, tone in enumerate(tones):
                expected[0, i, tone - 1] = 1
            # other modes enter by the rounding of the eigenvectors, 1e-15 in amplitude
            assert torch.allclose(share, expected[:, :, None].expand_as(share), rtol=0, atol=1e-13)
            late = tc.long_time_band_energy(ordered, state, N // 2, definition=definition)
            assert torch.allclose(late, expected, rtol=0, atol=1e-13)


# A ring without symmetry whose fourth and fifth mode share one frequency (Newton's method on the gap, in NumPy).
CROSSING = [
    1.2497736765847531, 1.1518244249632819, 0.5356420884150592,
    0.8836957842800396, 1.3424371676229587, 1.3682594001249007,
]  # fmt: skip


def test_cross_terms_of_a_pair_of_equal_frequency():
    # In symmetric rings, as the ordered one, the cross terms of a pair add up to nothing in every band; here they count.
    chain = tc.Chain(torch.tensor([CROSSING], dtype=torch.float64))
    frequencies = tc.normal_modes(chain).frequencies[0]
    assert abs(frequencies[4] - frequencies[3]) < 1e-14
    state = random_state((1, 6), seed=3)
    expected = literal.long_time_band_energy(
        np.array(CROSSING), matrix_of(chain, 0), state.displacement[0].numpy(), state.velocity[0].numpy(), 3
    )
    np.testing.assert_allclose(tc.long_time_band_energy(chain, state, 3)[0].numpy(), expected, atol=1e-12)
    times = torch.linspace(0, 1e5, 20_001, dtype=torch.float64)
    still_state = still(chain, state)
    for definition in ("site", "bond"):
        late = tc.long_time_band_energy(chain, still_state, 3, definition=definition)
        average = tc.band_energy(chain, tc.evolve(chain, still_state, times), 3, definition=definition).mean(-2)
        assert torch.allclose(average, late, atol=1e-4)  # beats of the other modes: 1 / (0.1 * 1e5)
    # what a sum without cross terms would give
    modes = tc.normal_modes(chain)
    apart = modes.frequencies + torch.tensor([0, 0, 0, 0, 1e-9, 0], dtype=torch.float64)
    wrong = tc.long_time_band_energy(chain, state, 3, modes=tc.NormalModes(apart, modes.shapes))
    assert abs(wrong[0].numpy() - expected).max() > 0.01


@pytest.mark.parametrize("light", [2, 3, 6])
def test_equal_light_beads_far_apart_share_one_frequency(light):
    # Each swings by itself, so that all their modes have one frequency to rounding, and the solver any basis of them.
    n = 12 * light
    masses = torch.ones(1, n, dtype=torch.float64)
    masses[0, 5::12] = 1e-3
    chain = tc.Chain(masses)
    top = tc.normal_modes(chain).frequencies[0, -light:]
    assert (top - top[-1]).abs().max() < 1e-13 * top[-1]
    state = random_state((1, n), seed=3)
    late = tc.long_time_band_energy(chain, state, light)[0]
    matrix = literal.stiffness_matrix(np.ones(n), n, "periodic")
    expected = literal.long_time_band_energy(
        masses[0].numpy(), matrix, state.displacement[0].numpy(), state.velocity[0].numpy(), light
    )
    np.testing.assert_allclose(late.numpy(), expected, atol=1e-10)


def test_a_traveling_wave_on_the_ordered_ring():
    # Its sine and its cosine part are a pair of equal frequency, in whatever basis the solver chose.
    chain = tc.Chain(torch.ones(1, N, dtype=torch.float64))
    state = tc.standing_wave(chain, 5, phase="cos") + tc.impulse(chain, 7, 0.02)
    late = tc.long_time_band_energy(chain, state, BANDS)[0]
    expected = literal.long_time_band_energy(
        np.ones(N), matrix_of(chain, 0), state.displacement[0].numpy(), state.velocity[0].numpy(), BANDS
    )
    np.testing.assert_allclose(late.numpy(), expected, atol=1e-13)


@pytest.mark.parametrize("kind", ["equal", "unequal", "fixed"])
def test_long_time_average_is_the_double_sum_over_modes(kind):
    chain = chain_of(kind)
    state = random_state((2, 3, N))  # with net momentum: the zero mode counts
    late = tc.long_time_band_energy(chain, state, BANDS)
    raw = tc.long_time_band_energy(chain, state, BANDS, normalize=False)
    total = tc.total_energy(chain, tc.evolve(chain, state, [0.0]))[..., 0]
    assert torch.allclose(raw, late * total[..., None], rtol=1e-13)
    for i, j in np.ndindex(2, 3):
        expected = literal.long_time_band_energy(
            chain.masses[i].numpy(), matrix_of(chain, i), state.displacement[i, j].numpy(),
            state.velocity[i, j].numpy(), BANDS,
        )  # fmt: skip
        np.testing.assert_allclose(late[i, j].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("definition", ["site", "bond"])
def test_long_time_average_is_the_average_over_time(definition):
    chain = chain_of("unequal")
    state = still(chain, tc.standing_wave(chain, [2, 9]) + tc.impulse(chain, 3))
    late = tc.long_time_band_energy(chain, state, BANDS, definition=definition)
    end, count = 2e5, 20_001
    times = torch.linspace(0, end, count, dtype=torch.float64)
    average = tc.band_energy(chain, tc.evolve(chain, state, times), BANDS, definition=definition).mean(-2)
    # What is left are beats of w_i - w_j, of order 1 / (gap end): the smallest gap here is above 1e-3.
    gap = tc.normal_modes(chain).frequencies.diff(dim=-1).min().item()
    assert gap > 1e-3
    assert torch.allclose(average, late, rtol=0, atol=2 / (gap * end))
    assert 2 / (gap * end) < 5e-3


def test_modes_at_hand_are_used():
    chain = chain_of("equal")
    state = tc.standing_wave(chain, [2, 9])
    given = tc.long_time_band_energy(chain, state, BANDS, modes=tc.normal_modes(chain))
    assert torch.equal(given, tc.long_time_band_energy(chain, state, BANDS))


def test_basis_fraction():
    xi, n_bands = 0.3, 32
    expected = [1 / n_bands + (1 - 1 / n_bands) * np.exp(-((xi * r / 2) ** 1.5)) for r in range(1, n_bands + 1)]
    np.testing.assert_allclose(tc.basis_fraction(xi, n_bands).numpy(), expected, rtol=1e-14)
    assert tc.basis_fraction(xi, n_bands)[9].item() == pytest.approx(0.19, abs=0.005)
    assert torch.equal(tc.basis_fraction(0.0, 5), torch.ones(5, dtype=torch.float64))
    assert torch.allclose(tc.basis_fraction(1e300, 5), torch.full((5,), 0.2, dtype=torch.float64))


EXAMPLE = chain_of("equal")
AT_REST = tc.State(torch.zeros(2, N, dtype=torch.float64), torch.zeros(2, N, dtype=torch.float64))
HUGE = tc.impulse(EXAMPLE, 1, 1e200)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda c, s: tc.band_energy(c, tc.evolve(c, s, [0.0]), 5), "n_bands must divide the number of tones"),
        (lambda c, s: tc.long_time_band_energy(c, s, 13), "n_bands must be at most the number of tones"),
        (lambda c, s: tc.band_energy(c, tc.evolve(c, s, [0.0]), 4, definition="x"), "definition must be one of"),
        (lambda c, s: tc.long_time_band_energy(c, s, 4, definition="x"), "definition must be one of site, bond"),
        (
            lambda c, s: tc.band_energy(c, tc.evolve(c, AT_REST, [0.0, 1.0]), 4),
            "total energy must be positive and finite to normalize, got 0 at realization 1, time 1",
        ),
        (lambda c, s: tc.long_time_band_energy(c, AT_REST, 4), "total energy must be positive .*at state 1"),
        (lambda c, s: tc.long_time_band_energy(c, HUGE, 4), "total energy must be positive and finite to normalize"),
        (lambda c, s: tc.band_energy(c, tc.evolve(c, HUGE, [0.0]), 4), "energy of trajectory must be finite, got inf"),
        (
            lambda c, s: tc.wavenumber_energy(tc.Chain(c.masses, contact="hertz"), tc.evolve(c, s, [0.0])),
            "contact must be 'linear' here",
        ),
        (lambda c, s: tc.long_time_band_energy(tc.Chain(c.masses, contact="hertz"), s, 4), "contact must be 'linear'"),
        (
            lambda c, s: tc.band_energy(tc.Chain(c.masses, "fixed"), tc.evolve(c, s, [0.0]), 4, definition="bond"),
            "boundary must be 'periodic' for definition 'bond'",
        ),
        (
            lambda c, s: tc.long_time_band_energy(tc.Chain(c.masses, "fixed"), s, 4, definition="bond"),
            "boundary must be 'periodic' for definition 'bond'",
        ),
        (lambda c, s: tc.basis_fraction(-1.0, 4), "strength must be at least 0"),
        (lambda c, s: tc.basis_fraction(float("nan"), 4), "strength must be finite"),
        (lambda c, s: tc.basis_fraction(0.3, 0), "n_bands must be at least 1"),
        (
            lambda c, s: tc.evolve(c, tc.State(torch.zeros(2, 7), torch.zeros(2, 7)), [0.0]),
            r"state must have 24 particles like the chain, got shape \(2, 7\)",
        ),
        (
            lambda c, s: tc.evolve(c, tc.State(torch.zeros(N), torch.zeros(N)), [0.0]),
            r"state must have leading axes \(2,\) like the chain's masses",
        ),
    ],
)
def test_bad_arguments(call, message):
    with pytest.raises(FieldError, match=message):
        call(EXAMPLE, tc.standing_wave(EXAMPLE, [2]))
