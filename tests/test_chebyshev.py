"""Chebyshev propagation: against modes, Bessel functions and symmetries; its kernels against plain torch; fused observables."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import special

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.ensemble import fused
from torchchain.ensemble.observables import is_fused
from torchchain.evolvers import chebyshev, coefficients, start

BOUNDARIES = ("fixed", "periodic")
IMPLEMENTATIONS = [pytest.param(True, id="compiled"), pytest.param(False, id="torch")]
GRIDS = {
    "uniform": torch.arange(51, dtype=torch.float64),
    "tenths": torch.arange(60, dtype=torch.float64) * 0.1,
    "scattered": torch.tensor([0.0, 1e-9, 0.3, 0.31, 2.0, 9.5, 9.75, 33.0, 50.0], dtype=torch.float64),
}


def a_chain(boundary, n=48, realizations=3, strength=0.3, stiffness=0.2, seed=0):
    masses = tc.Disorder(strength=strength).masses(n, realizations, seed)
    if not stiffness:
        return tc.Chain(masses, boundary)
    contacts = tc.Disorder(strength=stiffness).stiffnesses(n + (boundary == "fixed"), realizations, seed)
    return tc.Chain(masses, boundary, contacts)


def a_start(kind, chain):
    if kind == "impulse":
        return tc.impulse(chain, site=chain.n_particles // 3)
    if kind == "tones":
        return tc.standing_wave(chain, [1, 5, 11])
    generator = torch.Generator().manual_seed(5)
    shape = (*chain.batch_shape, chain.n_particles)
    return tc.State(*(torch.randn(shape, generator=generator, dtype=torch.float64) for _ in range(2)))


def error(one, other):
    """Largest difference, in units of the largest displacement or velocity."""
    pairs = [(one.displacement, other.displacement), (one.velocity, other.velocity)]
    return max((a - b).abs().max() for a, b in pairs) / max(b.abs().max() for _, b in pairs)


def chebyshev_states(chain, state, times, **options):
    return tc.evolve(chain, state, times, "chebyshev", **options)


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("kind", ["impulse", "tones", "random"])
@pytest.mark.parametrize("stiffness", [0.0, 0.2])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_agrees_with_modes(boundary, stiffness, kind, compiled):
    chain = a_chain(boundary, stiffness=stiffness)
    state = a_start(kind, chain)
    for times in GRIDS.values():
        expected = tc.evolve(chain, state, times, "modes")
        assert error(chebyshev_states(chain, state, times, compiled=compiled), expected) < 1e-12
    # one gap of 920, which is crossed in leaps
    times = torch.tensor([80.0, 1000.0], dtype=torch.float64)
    expected = tc.evolve(chain, state, times, "modes")
    assert error(chebyshev_states(chain, state, times, compiled=compiled), expected) < 1e-9


@pytest.mark.parametrize("times", [[2e7], [1e7, 1.5e7, 2e7]])
def test_one_long_interval_keeps_the_phase(times):
    """The rounding of the phases, W t eps = 1e-8, whatever the number of leaps to the time: some 2e5 here."""
    chain = tc.Chain(torch.tensor([1, 0.8, 1.3, 0.9], dtype=torch.float64), "fixed")
    state = tc.impulse(chain, 1)
    expected = tc.evolve(chain, state, times, "modes")
    limit = 20 * chain.squared_frequency_bound().sqrt().item() * times[-1] * torch.finfo(torch.float64).eps
    assert error(chebyshev_states(chain, state, times), expected) < limit


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_thousand_times_on_a_grid(boundary):
    chain = a_chain(boundary)
    state = a_start("random", chain)
    times = torch.arange(1001, dtype=torch.float64)
    assert error(chebyshev_states(chain, state, times), tc.evolve(chain, state, times, "modes")) < 1e-9


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_kernels_agree_with_torch(boundary):
    chain = a_chain(boundary, n=64, strength=0.5)
    for kind in ("impulse", "tones", "random"):
        state = a_start(kind, chain)
        for times in GRIDS.values():
            one, other = (chebyshev_states(chain, state, times, compiled=compiled) for compiled in (True, False))
            # Each rounds on its own way through some 100 stencils an output: both are 9e-14 off the modes.
            assert error(one, other) < 1.5e-13


@pytest.mark.parametrize("grid", ["last", "all"])
def test_ordered_infinite_chain_is_bessel(grid):
    """A kick at the center: v_n(t) = v0 J_2n(2t), until the front, sound at speed 1, reaches a wall."""
    chain = tc.Chain(torch.ones(961, dtype=torch.float64), "fixed")
    times = torch.tensor([400.0]) if grid == "last" else torch.arange(401)
    trajectory = chebyshev_states(chain, tc.impulse(chain, 481, velocity=1.0), times.double())
    expected = special.jv(2 * np.arange(-480, 481), 800.0)
    assert np.abs(trajectory.velocity[-1].numpy() - expected).max() < 1e-12
    # a wave that has not arrived has a size, down to the trimming
    assert np.abs(trajectory.velocity[-1].numpy() - expected)[:40].max() < 1e-15


def test_moments_of_the_bessel_solution():
    """Bond energies of the kicked ordered chain: J_2n^2 / 2 and halves of the contacts' J_(2n+1)^2 / 2."""
    chain = tc.Chain(torch.ones(961, dtype=torch.float64), "fixed")
    times = torch.arange(1, 401, dtype=torch.float64)
    moments = fused.energy_moments(chain, tc.impulse(chain, 481, velocity=1.0), times, "bond")
    n = np.arange(-480, 481)
    order = np.concatenate([2 * n, [962]])
    for t in (1.0, 57.0, 400.0):
        contact = special.jv(order - 1, 2 * t) ** 2
        energy = special.jv(order[:-1], 2 * t) ** 2 / 2 + (contact[:-1] + contact[1:]) / 4
        at = int(t) - 1
        assert moments.total[at].item() == pytest.approx(0.5, rel=1e-12)
        assert moments.center[at].item() == pytest.approx(481, rel=1e-12)
        assert moments.width[at].item() == pytest.approx((n**2 * energy).sum() / energy.sum(), rel=1e-11)


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_time_reversal(boundary, compiled):
    chain = a_chain(boundary)
    state = a_start("random", chain)
    there = chebyshev_states(chain, state, [70.0], compiled=compiled).final
    back = chebyshev_states(chain, tc.State(there.displacement, -there.velocity), [70.0], compiled=compiled).final
    assert (back.displacement - state.displacement).abs().max() < 1e-11
    assert (back.velocity + state.velocity).abs().max() < 1e-11


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_reciprocity(boundary):
    """A momentum given to p moves q as the same momentum given to q moves p."""
    chain = a_chain(boundary, realizations=1)
    p, q = 5, 31
    moved = []
    for source, receiver in ((p, q), (q, p)):
        velocity = torch.zeros_like(chain.masses)
        velocity[0, source] = 1 / chain.masses[0, source]
        trajectory = chebyshev_states(chain, tc.State(torch.zeros_like(velocity), velocity), GRIDS["uniform"])
        moved.append(trajectory.displacement[0, :, receiver])
    assert moved[0].abs().max() > 0.1
    assert (moved[0] - moved[1]).abs().max() < 1e-13


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
def test_ring_keeps_its_momentum(compiled):
    chain = a_chain("periodic")
    state = a_start("random", chain)
    times = torch.tensor([10.0, 300.0, 3000.0], dtype=torch.float64)
    trajectory = chebyshev_states(chain, state, times, compiled=compiled)
    mass = chain.masses.sum(-1, keepdim=True)
    momentum = (chain.masses[:, None] * trajectory.velocity).sum(-1)
    start = (chain.masses * state.velocity).sum(-1, keepdim=True)
    assert (momentum - start).abs().max() < 1e-12 * mass.max()
    center = (chain.masses[:, None] * trajectory.displacement).sum(-1) / mass
    begin = (chain.masses * state.displacement).sum(-1, keepdim=True) / mass
    assert (center - begin - times * start / mass).abs().max() < 1e-11 * times.max()


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
def test_a_translation_stays_one(compiled):
    chain = a_chain("periodic")
    shift = torch.full_like(chain.masses, 0.3)
    trajectory = chebyshev_states(chain, tc.State(shift, shift / 10), GRIDS["scattered"], compiled=compiled)
    expected = 0.3 + 0.03 * GRIDS["scattered"][:, None]
    assert (trajectory.displacement / expected - 1).abs().max() < 1e-14
    assert (trajectory.velocity / 0.03 - 1).abs().max() < 3e-14


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_chain_alone_equals_itself_in_a_batch(boundary, compiled):
    chain = a_chain(boundary, realizations=4, strength=0.5)
    state = a_start("tones", chain)
    times = torch.tensor([0.0, 0.7, 1.4, 3.0, 200.0], dtype=torch.float64)
    together = chebyshev_states(chain, state, times, compiled=compiled)
    for r in range(4):
        alone = tc.Chain(chain.masses[r], boundary, chain.contact_stiffness[r])
        for tone in (0, 2):
            one = chebyshev_states(
                alone, tc.State(state.displacement[r, tone], state.velocity[r, tone]), times, compiled=compiled
            )
            assert torch.equal(one.displacement, together.displacement[r, tone])
            assert torch.equal(one.velocity, together.velocity[r, tone])


def test_threads_do_not_change_a_bit():
    chain = a_chain("periodic", realizations=5, stiffness=0)
    state = a_start("tones", chain)
    times = GRIDS["uniform"]
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        states = chebyshev_states(chain, state, times)
        moments = fused.energy_moments(chain, state, times)
        results.append(
            [states.displacement, states.velocity, moments.center, fused.band_energy(chain, state, times, 8)]
        )
        assert torch.get_num_threads() == threads
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("kind", ["impulse", "random"])
def test_windows_do_not_change_a_bit(kind, compiled):
    chain = a_chain("periodic")
    state = a_start(kind, chain)
    for times in GRIDS.values():
        whole = chebyshev_states(chain, state, times, compiled=compiled)
        for sizes in ([1] * len(times), [2, 1, 4, len(times) - 7]):
            advance = start(chain, state, "chebyshev", compiled=compiled)
            parts = [advance(window) for window in times.split(sizes)]
            assert torch.equal(torch.cat([part.displacement for part in parts], dim=-2), whole.displacement)
            assert torch.equal(torch.cat([part.velocity for part in parts], dim=-2), whole.velocity)


@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradients(boundary):
    contacts = 4 + (boundary == "fixed")
    generator = torch.Generator().manual_seed(2)
    inputs = [
        (0.5 + torch.rand(*shape, generator=generator, dtype=torch.float64)).requires_grad_()
        for shape in ((2, 4), (2, contacts), (2, 4), (2, 4))
    ]
    times = torch.tensor([0.4, 2.0], dtype=torch.float64)

    def states(masses, stiffness, displacement, velocity):
        trajectory = chebyshev_states(tc.Chain(masses, boundary, stiffness), tc.State(displacement, velocity), times)
        return trajectory.displacement, trajectory.velocity

    assert torch.autograd.gradcheck(states, inputs)
    with torch.no_grad():  # the kernels
        compiled = states(*inputs)
    for one, other in zip(states(*inputs), compiled, strict=True):
        assert (one - other).abs().max() < 1e-13


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("accuracy", [1e-2, 1e-5, 1e-9])
def test_truncation_keeps_to_the_accuracy(accuracy, compiled):
    chain = a_chain("fixed", strength=0.1)
    state = a_start("random", chain)
    times = torch.arange(1, 101, dtype=torch.float64)
    exact = tc.evolve(chain, state, times, "modes")
    rough = chebyshev_states(chain, state, times, accuracy=accuracy, compiled=compiled)
    squared = chain.squared_frequency_bound()[:, None]
    norm = chain.masses[:, None]

    def size(displacement, velocity):
        return (squared * (norm * displacement**2).sum(-1) + (norm * velocity**2).sum(-1)).sqrt()

    off = size(rough.displacement - exact.displacement, rough.velocity - exact.velocity)
    assert (off / size(exact.displacement, exact.velocity)).max() < accuracy


def test_coefficients():
    """The table of both implementations: the functions at the ends of the spectrum, and a sum that is the motion at x."""
    frequency = np.array([0.7, 2.0, 5.3])
    for time in (1e-9, 0.01, 1.0, 40.0):
        table = coefficients.coefficients_of(frequency, np.full(3, time), 1e-16)
        assert table.sum(1) == pytest.approx(np.array([[1.0] * 3, [time] * 3, [0.0] * 3]), rel=1e-14, abs=1e-14)
        angle = np.linspace(0, np.pi, 7)[:, None]
        polynomials = np.cos(np.arange(table.shape[1]) * angle)
        w = frequency * np.sin(angle / 2)  # x = 1 - 2 w^2 / W^2 = cos(angle)
        for values, function in zip(
            table, (np.cos(w * time), time * np.sinc(w * time / np.pi), -w * np.sin(w * time)), strict=True
        ):
            assert polynomials @ values == pytest.approx(function, abs=1e-14 * max(1, time))


def test_coefficients_are_bessel_functions():
    for frequency, time in ((2.0, 1e-8), (2.0, 1.0), (3.7, 3.0), (5.0, 50.0)):
        z, k = frequency * time, np.arange(1, 200)
        odd = np.cumsum(special.jv(2 * np.arange(400) + 1, z)[::-1])[::-1]
        expected = np.stack(
            [
                2 * special.jv(2 * k, z),
                4 / frequency * odd[k],
                frequency * (special.jv(2 * k - 1, z) - special.jv(2 * k + 1, z)),
            ]
        )
        table = coefficients.coefficients_of(np.array([frequency]), np.array([time]), 1e-16)[:, 1:, 0]
        # SciPy's Bessel functions are good to some eps
        assert table == pytest.approx(expected[:, : table.shape[1]], abs=1e-14 * max(1, time) * frequency)
        # the order from which on Bessel functions are left out
        assert np.abs(special.jv(coefficients.top_order(z), z)) < 1e-25


@pytest.mark.parametrize("z", [1e-3, 1.0, 30.0, 256.0, 1e4, 1e6])
def test_bessel_functions_left_out(z):
    """Kapteyn: |J_v(z)| <= exp(-v (a - tanh a)) with v = z cosh a, whatever z."""
    order = coefficients.top_order(z)
    a = np.arccosh(order / z)
    assert -order * (a - np.tanh(a)) < np.log(1e-25)


@pytest.mark.parametrize("n", [2, 3, 48])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_default_bounds(boundary, n):
    from torchchain.evolvers import stencil

    chain = a_chain(boundary, n=n, strength=0.5)
    contacts = torch.cat([chain.contact_stiffness, chain.contact_stiffness[:, :1]], dim=-1).numpy()
    bounds = np.empty(3)
    stencil.squared_bounds(0, 3, chain.masses.numpy(), contacts, boundary == "periodic", 8, bounds)
    assert bounds == pytest.approx(chain.squared_frequency_bound(8).numpy(), rel=1e-14)
    top = tc.normal_modes(chain).frequencies[:, -1]
    assert (start(chain, a_start("random", chain), "chebyshev").rows.frequencies >= top.numpy()).all()
    assert (chebyshev.highest_frequency(chain) >= top).all()


@pytest.mark.parametrize("n", [2, 3, 24])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_a_bound_below_the_spectrum_is_refused(boundary, n):
    chain = a_chain(boundary, n=n, realizations=3, strength=0.5)
    state = a_start("random", chain)
    top = tc.normal_modes(chain).frequencies[:, -1].square()
    expected = tc.evolve(chain, state, [30.0], "modes")
    for bound in (top * (1 + 1e-9), float(top.max()) * 3):
        assert error(chebyshev_states(chain, state, [30.0], bound=bound), expected) < 1e-12
    low = top.clone()
    low[1] *= 1 - 1e-9
    message = r"bound must not lie below the largest squared frequency .*, got .* at chain 2"
    for compiled in (True, False):
        with pytest.raises(FieldError, match=message):
            chebyshev_states(chain, state, [30.0], bound=low, compiled=compiled)


def test_one_light_particle_is_not_overlooked():
    """Its mode is localized: no start elsewhere, and few power iterations, would show it."""
    masses = torch.ones(400, dtype=torch.float64)
    masses[317] = 0.2
    chain = tc.Chain(masses, "fixed")
    with pytest.raises(FieldError, match=r"bound must not lie below .*, got 4.5$"):
        chebyshev_states(chain, tc.impulse(chain, 1), [1.0], bound=4.5)


@pytest.mark.parametrize(
    ("options", "error_type", "message"),
    [
        ({"accuracy": 0}, FieldError, "accuracy must be greater than 0, got 0"),
        ({"accuracy": "fine"}, FieldTypeError, "accuracy must be a number, got 'fine'"),
        ({"bound": -1.0}, FieldError, "bound must be positive, got -1"),
        ({"bound": torch.ones(2)}, FieldError, "bound must be a number or have shape (3,), got shape (2,)"),
        ({"bound": "high"}, FieldTypeError, "bound must be real numbers, got 'high'"),
        ({"compiled": 1}, FieldTypeError, "compiled must be True, False or None, got 1"),
        ({"degree": 9}, FieldError, "options of method 'chebyshev' must have only the keys"),
    ],
)
def test_options_are_checked(options, error_type, message):
    chain = a_chain("fixed")
    with pytest.raises(error_type) as caught:
        chebyshev_states(chain, a_start("impulse", chain), [1.0], **options)
    assert str(caught.value).startswith(message)


def test_kernels_refuse_gradients():
    chain = a_chain("fixed")
    chain = replace(chain, masses=chain.masses.clone().requires_grad_())
    with pytest.raises(FieldError, match="compiled must be False for tensors"):
        chebyshev_states(chain, a_start("impulse", chain), [1.0], compiled=True)


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
def test_times_do_not_go_back(compiled):
    chain = a_chain("fixed")
    advance = start(chain, a_start("impulse", chain), "chebyshev", compiled=compiled)
    advance(torch.tensor([1.0, 2.0]))
    with pytest.raises(FieldError, match=r"times must not go back behind the last window's end 2, got 1\.5"):
        advance(torch.tensor([1.5]))


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
def test_single_precision(compiled):
    chain = a_chain("periodic")
    state = a_start("tones", chain)
    times = GRIDS["uniform"]
    expected = tc.evolve(chain, state, times, "modes")
    low = tc.Chain(chain.masses.float(), "periodic", chain.contact_stiffness.float())
    start32 = tc.State(state.displacement.float(), state.velocity.float())
    trajectory = chebyshev_states(low, start32, times, compiled=compiled)
    assert trajectory.displacement.dtype == trajectory.velocity.dtype == torch.float32
    assert error(trajectory, expected) < 1e-5
    if compiled:
        assert fused.energy_moments(low, start32, times).center.dtype == torch.float32
        assert fused.band_energy(low, start32, times, 8).dtype == torch.float32


def test_units_do_not_matter():
    """Stiffness 1e4 is time in units of 1/100; an amplitude whose square underflows is a factor."""
    chain = a_chain("fixed", stiffness=0)
    state = a_start("impulse", chain)
    expected = chebyshev_states(chain, state, [1.0, 40.0])
    stiff = tc.Chain(chain.masses, "fixed", 1e4)
    quick = chebyshev_states(stiff, tc.State(state.displacement, 100 * state.velocity), [0.01, 0.4])
    assert error(tc.Trajectory(quick.times, quick.displacement, quick.velocity / 100), expected) < 1e-12
    tiny = chebyshev_states(chain, tc.State(state.displacement, 1e-180 * state.velocity), [1.0, 40.0])
    assert error(tc.Trajectory(tiny.times, tiny.displacement * 1e180, tiny.velocity * 1e180), expected) < 1e-12


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("definition", ["site", "bond"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_moments(boundary, definition, grid, compiled):
    chain = a_chain(boundary)
    for kind in ("impulse", "tones"):
        state = a_start(kind, chain)
        moments = fused.energy_moments(chain, state, GRIDS[grid], definition, compiled=compiled)
        energy = tc.particle_energy(chain, tc.evolve(chain, state, GRIDS[grid], "modes"), definition)
        assert (moments.total / energy.sum(-1) - 1).abs().max() < 1e-11
        assert (moments.center - tc.energy_center(energy)).abs().max() < 1e-9
        assert (moments.width - tc.energy_width(energy)).abs().max() < 1e-9


def test_moments_over_a_long_time():
    chain = a_chain("fixed", n=128, realizations=2, strength=0.1, stiffness=0)
    state = tc.impulse(chain, 1)
    times = torch.arange(1001, dtype=torch.float64)
    moments = fused.energy_moments(chain, state, times)
    energy = tc.particle_energy(chain, tc.evolve(chain, state, times, "modes"))
    assert (moments.center / tc.energy_center(energy) - 1).abs().max() < 1e-9
    assert ((moments.width - tc.energy_width(energy)) / tc.energy_width(energy).clamp(min=1e-3)).abs().max() < 1e-9


def test_width_far_from_the_origin():
    """At site 60000 the second moment about site 0 is 4e9 and the width at first 1e-6: nothing may cancel."""
    masses = torch.ones(60100, dtype=torch.float64)
    chain = tc.Chain(masses, "fixed")
    near = tc.Chain(masses[:201], "fixed")
    times = torch.tensor([0.001, 0.01, 1.0, 20.0], dtype=torch.float64)
    far = fused.energy_moments(chain, tc.impulse(chain, 60000), times)
    expected = fused.energy_moments(near, tc.impulse(near, 101), times)
    assert expected.width[0] < 1e-5
    assert (far.width / expected.width - 1).abs().max() < 1e-9


CHAINS = [
    pytest.param(boundary, stiffness, definition, id=f"{boundary}-{stiffness}-{definition}")
    for boundary, stiffness, definition in (
        ("periodic", 0.0, "site"),
        ("periodic", 0.2, "site"),
        ("periodic", 0.2, "bond"),
        ("fixed", 0.0, "site"),
    )
]


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
@pytest.mark.parametrize(("boundary", "stiffness", "definition"), CHAINS)
def test_bands(boundary, stiffness, definition, compiled):
    chain = a_chain(boundary, stiffness=stiffness)
    state = a_start("tones", chain)
    for times in GRIDS.values():
        trajectory = tc.evolve(chain, state, times, "modes")
        for normalize in (True, False):
            expected = tc.band_energy(chain, trajectory, 8, normalize, definition)
            bands = fused.band_energy(chain, state, times, 8, normalize, definition, compiled=compiled)
            assert bands.shape == (3, 3, len(times), 8)
            assert (bands - expected).abs().max() < 1e-11 * expected.abs().max()


@pytest.mark.parametrize("compiled", IMPLEMENTATIONS)
def test_bands_after_a_release_and_after_a_kick(compiled):
    chain = a_chain("periodic", stiffness=0)
    shape = a_start("tones", chain).displacement + 0.3  # as velocities, a motion of the ring as a whole
    released, struck = tc.State(shape, torch.zeros_like(shape)), tc.State(torch.zeros_like(shape), shape)
    for times in GRIDS.values():
        found = fused.both_band_energies(chain, released, times, 8, compiled=compiled)
        for bands, state in zip(found, (released, struck), strict=True):
            expected = tc.band_energy(chain, tc.evolve(chain, state, times, "modes"), 8)
            assert bands.shape == (3, 3, len(times), 8)
            assert (bands - expected).abs().max() < 1e-11


def test_starts_are_measured_in_the_kernels_where_rings_are_uniform():
    """The same as from the states, which rings of unlike contacts leave behind."""
    scene = tc.Scene(
        n_particles=48,
        n_bands=8,
        realizations=3,
        times=[0.0, 2.0, 30.0],
        observables=("band_energy", "kicked_band_energy"),
    )
    assert is_fused("chebyshev", scene)
    assert not is_fused("chebyshev", replace(scene, stiffness_disorder=tc.Disorder("gamma", 0.1)))
    assert not is_fused("chebyshev", replace(scene, boundary="fixed"))
    found, expected = (tc.simulate(scene, method) for method in ("chebyshev", "modes"))
    for name in scene.observables:
        assert abs(found[name] - expected[name]).max() < 1e-10


def test_bands_in_small_pieces(monkeypatch):
    """Windows of times and a few rows at a time, none of which ends where a realization does."""
    chain = a_chain("periodic", stiffness=0)
    state = a_start("tones", chain)
    whole = fused.band_energy(chain, state, GRIDS["uniform"], 8)
    for block in (8 * 48 * 51 * 2, 8 * 48 * 7):
        monkeypatch.setattr(fused, "_BLOCK", block)
        assert (fused.band_energy(chain, state, GRIDS["uniform"], 8) - whole).abs().max() < 1e-12


def test_fused_observables_refuse_what_has_no_meaning():
    ring, fixed = a_chain("periodic"), a_chain("fixed")
    rest = tc.State(torch.zeros_like(ring.masses), torch.zeros_like(ring.masses))
    for compiled in (True, False):
        with pytest.raises(FieldError, match="total energy must be positive"):
            fused.energy_moments(ring, rest, [1.0], compiled=compiled)
        with pytest.raises(FieldError, match="total energy must be positive"):
            fused.band_energy(ring, rest, [1.0], 8, compiled=compiled)
        with pytest.raises(FieldError, match="boundary must be 'periodic' for definition 'bond'"):
            fused.band_energy(fixed, a_start("tones", fixed), [1.0], 8, definition="bond", compiled=compiled)
    with pytest.raises(FieldError, match="n_bands must divide"):
        fused.band_energy(ring, rest, [1.0], 7)
    with pytest.raises(FieldError, match="definition must be one of"):
        fused.energy_moments(ring, rest, [1.0], "mode")
    with pytest.raises(FieldError, match="damping must be zero"):
        fused.energy_moments(replace(ring, damping=0.1), rest, [1.0])


def test_numba_is_imported_on_first_use():
    code = "import sys, torchchain as tc; tc.evolve; tc.METHODS; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
