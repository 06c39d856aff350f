"""Band energies from the theory: the medium against counted modes, the transfer against chains and its exact limits."""

import math

import pytest
import torch
from scipy import stats

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.energy.bands import center_tones
from torchchain.theory import born_rates, effective_medium, theory_transfer
from torchchain.theory.crossed import crossed_transfer
from torchchain.theory.ladder import spectrum_edges
from torchchain.theory.law import law_of
from torchchain.theory.localized import density_correlation
from torchchain.theory.mean_wave import mean_resolvent
from torchchain.theory.medium import coherent_mass, site_resolvent, wavenumber
from torchchain.theory.transfer import described

TIMES = torch.tensor([0.0, 1.0, 2.0, 4.0, 8.0, 32.0, 100.0], dtype=torch.float64)
KINDS = ("normal", "uniform", "binary", "lognormal", "gamma")


def distance(a, b):
    """Total variation over receivers, mean over sources."""
    return (a - b).abs().sum(-1).mean(0) / 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("xi", [0.05, 0.3, 0.6])
def test_law_has_the_moments_of_the_masses(kind, xi):
    disorder = tc.Disorder(kind=kind, strength=xi)
    law = law_of(disorder)
    masses = disorder.masses(10**5, 2, seed=3)
    assert float(law.weights.sum()) == pytest.approx(1, abs=1e-12)
    for power in (1, 2, -1):
        sample = masses**power
        stderr = float(sample.std()) / math.sqrt(sample.numel())
        assert abs(law.moment(power) - float(sample.mean())) < 5 * stderr


def test_law_is_that_of_the_cut_normal_distribution():
    disorder = tc.Disorder(strength=0.5, lower=0.05)
    cut = stats.truncnorm((0.05 - 1) / 0.5, math.inf, loc=1, scale=0.5)
    law = law_of(disorder)
    assert law.mean == pytest.approx(cut.mean(), rel=1e-12)
    assert law.variance == pytest.approx(cut.var(), rel=1e-11)
    assert law.moment(6) == pytest.approx(cut.moment(6), rel=1e-11)


@pytest.mark.parametrize("n", [2, 3, 17, 64])
def test_resolvent_of_a_ring_is_the_sum_over_its_wavenumbers(n):
    e = torch.tensor([0.3 + 0.2j, 2.5 + 0.01j, 5.0 + 1j, 1.0 + 3j], dtype=torch.complex128)
    squares = 4 * torch.sin(math.pi * torch.arange(n, dtype=torch.float64) / n).square()
    torch.testing.assert_close(site_resolvent(e, n), (1 / (squares[:, None] - e)).mean(0), rtol=1e-11, atol=1e-13)
    torch.testing.assert_close(4 * torch.sin(wavenumber(e) / 2).square().real, e.real, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_coherent_particle_scatters_nothing_on_average(kind):
    law = law_of(tc.Disorder(kind=kind, strength=0.4))
    z = torch.complex(torch.linspace(0.05, 3.0, 40, dtype=torch.float64), torch.full((40,), 0.02, dtype=torch.float64))
    mass, residual = coherent_mass(z, law)
    g = site_resolvent(z.square() * mass)
    potential = z.square()[:, None] * (law.values - mass[:, None])
    scattering = (potential / (1 - potential * g[:, None])) @ law.weights.to(z)
    assert residual < 1e-10
    assert float(scattering.abs().max()) < 1e-8
    assert float((z.square() * mass).imag.min()) > 0


@pytest.mark.parametrize("kind", ["normal", "lognormal", "gamma"])
def test_density_of_states_counts_the_modes(kind):
    disorder = tc.Disorder(kind=kind, strength=0.3)
    w = torch.linspace(0.002, 8.0, 4000, dtype=torch.float64)
    density = effective_medium(disorder, w, broadening=1e-6).density_of_states
    counted = (torch.cumsum(density, 0) - density / 2) * float(w[1] - w[0])
    at = torch.tensor([0.5, 1.0, 1.5, 1.8], dtype=torch.float64)
    exact = tc.integrated_density_of_states(disorder, at, n_particles=2000, realizations=10)
    theory = torch.stack([counted[int((w - x).abs().argmin())] for x in at])
    # 0.2 % of the modes: what a single-site theory misses, beside the error of the count.
    assert float((theory - exact.value).abs().max()) < 0.002 + 4 * float(exact.stderr.max())
    assert float(counted[-1]) == pytest.approx(1, abs=2e-3)


def test_spectral_function_is_normalized_and_narrows_to_the_born_rate():
    xi, k = 0.05, torch.tensor([1.5, 2.0], dtype=torch.float64)
    w = torch.linspace(0.001, 2.3, 9001, dtype=torch.float64)
    medium = effective_medium(tc.Disorder(strength=xi), w, broadening=1e-6)
    spectral = medium.spectral_function(k)
    torch.testing.assert_close(torch.trapezoid(spectral, w), torch.ones(2, dtype=torch.float64), rtol=0, atol=2e-3)
    # A Lorentzian of full width Gamma has the height 2 / (pi Gamma).
    torch.testing.assert_close(2 / (math.pi * spectral.amax(-1)), born_rates(xi, k), rtol=0.03, atol=0)


def test_localization_length_is_that_of_matsuda_and_ishii():
    w = torch.tensor([0.4, 0.8, 1.2], dtype=torch.float64)
    medium = effective_medium(tc.Disorder(strength=0.1), w)
    torch.testing.assert_close(1 / medium.localization_length, tc.weak_disorder_lyapunov(0.1, w), rtol=0.02, atol=0)


def test_density_correlation_is_gogolins():
    x = torch.tensor([0.0, 0.3, 1.0, 5.0], dtype=torch.float64)
    u = torch.linspace(1e-4, 9, 40001, dtype=torch.float64)
    weight = u * torch.sinh(math.pi * u) * ((1 + u**2) / (1 + torch.cosh(math.pi * u))) ** 2
    width = (1 + u**2) / 8  # half widths of exp(-(1 + u^2) |y| / 4 l), l = 2, in 1 / y
    exact = torch.trapezoid(math.pi**2 / 32 * weight * 2 * width / (width**2 + x[:, None] ** 2), u)
    assert float(exact[0]) == pytest.approx(1, abs=1e-6)
    torch.testing.assert_close(density_correlation(x), exact, rtol=0, atol=2e-5)


def test_density_correlation_is_that_of_modes():
    """Of the energy of a mode along a chain, which does not swing as its amplitude does."""
    n, near = 512, 1.2
    chain = tc.Chain(tc.Disorder(strength=0.2).masses(n, 6, seed=1))
    modes = tc.normal_modes(chain)
    stretch = (modes.shapes.roll(-1, 1) - modes.shapes).square() / 2
    energy = chain.masses[:, :, None] * (modes.frequencies[:, None] * modes.shapes).square() / 2
    energy = energy + (stretch + stretch.roll(1, 1)) / 2
    energy = (energy / energy.sum(1, keepdim=True)).mT[(modes.frequencies - near).abs() < 0.06]
    measured = torch.fft.rfft(energy).abs().square().mean(0)[1:13]
    length = 1 / effective_medium(tc.Disorder(strength=0.2), [near]).wavenumber.imag  # 45 particles
    found = density_correlation(2 * math.pi / n * torch.arange(1.0, 13.0).double() * length / 2)
    torch.testing.assert_close(found, measured, rtol=0, atol=0.035)  # of 145 modes; from 0.50 down to 0.014


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("xi", [0.1, 0.5])
def test_transfer_starts_at_one_keeps_the_energy_and_is_not_negative_at_infinity(kind, xi):
    result = theory_transfer(tc.Disorder(kind=kind, strength=xi), 64, 8, TIMES)
    torch.testing.assert_close(result.mean[:, 0], torch.eye(8, dtype=torch.float64), rtol=0, atol=1e-6)
    torch.testing.assert_close(result.mean.sum(-1), torch.ones(8, len(TIMES), dtype=torch.float64), rtol=0, atol=1e-9)
    assert result.settings["closure"] < 1e-6  # the contour's own error, before rows were scaled
    assert float(result.long_time.min()) >= 0
    torch.testing.assert_close(result.long_time.sum(-1), torch.ones(8, dtype=torch.float64), rtol=0, atol=1e-9)


def test_transfer_does_not_depend_on_the_contour():
    disorder = tc.Disorder(strength=0.3)
    results = [theory_transfer(disorder, 64, 8, TIMES, localization=False, decay=d).mean for d in (9.0, 11.0)]
    torch.testing.assert_close(*results, rtol=0, atol=1e-6)


def test_ordered_chain_keeps_its_waves():
    result = theory_transfer(tc.Disorder(strength=0.0), 64, 8, TIMES)
    eye = torch.eye(8, dtype=torch.float64)
    torch.testing.assert_close(result.mean, eye[:, None].expand_as(result.mean), rtol=0, atol=1e-6)
    torch.testing.assert_close(result.long_time, eye, rtol=0, atol=1e-5)


def test_leaving_energy_falls_as_the_square_of_a_weak_disorder():
    lost = [1 - theory_transfer(tc.Disorder(strength=xi), 64, 8, [20.0]).mean[6, 0, 6] for xi in (1e-3, 2e-3)]
    assert float(lost[1] / lost[0]) == pytest.approx(4, rel=0.01)


@pytest.fixture(scope="module")
def chains():
    """Rings that did not enter the measurement of the enhanced return."""
    scene = tc.Scene(
        n_particles=64, n_bands=8, disorder=tc.Disorder(strength=0.2), times=TIMES, realizations=400, seed=5
    )
    return tc.band_transfer(scene, starts=False)


def test_transfer_is_that_of_chains(chains):
    result = theory_transfer(tc.Disorder(strength=0.2), 64, 8, TIMES)
    noise = 0.4 * chains.stderr.sum(-1).mean(0)  # mean distance of an ensemble from an endless one
    error = distance(result.mean, chains.mean)
    early = TIMES <= 8
    assert bool((error[early] <= 1.5 * noise[early] + 1e-7).all())
    assert bool((error <= 0.015 + noise).all())
    assert float(distance(result.long_time, chains.long_time)) <= 0.008


def crossed(xi, kind="normal"):
    law, waves = described(tc.Disorder(kind=kind, strength=xi), 64, 8, [22, 30], "periodic", None, "linear", 0.0)
    return crossed_transfer(law, waves, torch.tensor([0.0, 6.0, 12.0], dtype=torch.float64), spectrum_edges(law)[0])[0]


@pytest.mark.parametrize("kind", ["normal", "gamma"])
def test_crossed_scattering_keeps_the_energy(kind):
    change = crossed(0.3, kind)
    assert float(change.abs().max()) > 0.005
    assert float(change.sum(-1).abs().max()) < 2e-4 * float(change.abs().max())
    assert bool((change[:, 0] == 0).all())


def test_crossed_scattering_is_of_fourth_order():
    weak, strong = crossed(0.03), crossed(0.06)
    torch.testing.assert_close(strong, 16 * weak, rtol=0, atol=0.1 * float(strong.abs().max()))


def test_crossed_scattering_is_what_the_ladder_lacks_at_early_times(chains):
    disorder = tc.Disorder(strength=0.2)
    whole, ladder = (theory_transfer(disorder, 64, 8, [8.0], localization=x).mean for x in (True, False))
    measured = chains.mean[:, TIMES == 8]
    assert float(distance(whole, measured)) < 0.6 * float(distance(ladder, measured))


def test_theory_is_negative_where_chains_are(chains):
    """The kinetic energy of definition "site" is no square: an ensemble's mean can be below 0, and only there is the theory."""
    result = theory_transfer(tc.Disorder(strength=0.2), 64, 8, TIMES).mean
    below = chains.mean < -5 * chains.stderr - 2e-5
    assert int(below.sum()) > 3
    assert bool((result[below] < 0).all())
    assert bool((result[chains.mean > 3 * chains.stderr + 2e-5] > -2e-5).all())


@pytest.mark.parametrize("xi", [0.3, 0.7])
def test_mean_wave_is_that_of_all_rings_of_two_masses(xi):
    n = 10  # every one of the 2^10 rings; at this height above the axis a wave does not come around
    z = torch.tensor([0.4 + 1.0j, 1.5 + 1.0j, 2.2 + 1.0j, 4.0 + 1.0j], dtype=torch.complex128)
    k = 2 * math.pi / n * torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)
    shift = torch.roll(torch.eye(n, dtype=torch.float64), 1, 0)
    waves = torch.exp(1j * k[:, None] * torch.arange(n)) / math.sqrt(n)
    masses = 1 + xi * (2.0 * ((torch.arange(2**n)[:, None] >> torch.arange(n)) & 1).double() - 1)
    matrix = (2 * torch.eye(n) - shift - shift.T) - z[:, None, None, None] ** 2 * torch.diag_embed(masses)
    counted = torch.einsum("ki,zij,kj->kz", waves.conj(), torch.linalg.inv(matrix).mean(1), waves)
    exact, medium = mean_resolvent(z, law_of(tc.Disorder("binary", xi)), k)
    error = (exact - counted).abs() / counted.abs()
    assert float(error.max()) < 1e-3
    assert bool((error[:, 1:3] < 0.1 * ((medium - counted).abs() / counted.abs())[:, 1:3]).all())


@pytest.mark.parametrize(("xi", "top", "most"), [(0.3, 2.8, 2e-3), (0.5, 3.3, 2e-3), (0.7, 4.2, 0.01)])
def test_mean_wave_has_converged_close_above_the_axis(xi, top, most):
    """Also where the spectrum of clusters ends, at 2 / sqrt(1 - xi), which the medium knows nothing of."""
    w = torch.cat([torch.linspace(0.05, top, 40, dtype=torch.float64), 2 / math.sqrt(1 - xi) + torch.tensor([-0.02, 0.0, 0.02])])
    z, k = torch.complex(w, torch.full_like(w, 0.1)), torch.tensor([0.8, 2.2, 3.0], dtype=torch.float64)
    few, many = (mean_resolvent(z, law_of(tc.Disorder("binary", xi)), k, orders)[0] for orders in (32, 64))
    assert float(((few - many).abs() / many.abs()).max()) < most


def test_clusters_of_light_particles_beat():
    times = torch.tensor([16.0, 40.0, 100.0, 200.0], dtype=torch.float64)
    disorder = tc.Disorder("binary", 0.5)
    scene = tc.Scene(n_particles=64, n_bands=8, disorder=disorder, times=times, realizations=200, seed=4)
    measured, result = tc.band_transfer(scene, "modes", starts=False).mean, theory_transfer(disorder, 64, 8, times)
    assert float(distance(result.mean, measured).max()) < 0.025
    # Of short waves the mean wave itself is left, which no medium of single particles keeps.
    own = torch.arange(8)
    excess, theory = ((mean - result.long_time[:, None])[own, :, own] for mean in (measured, result.mean))
    assert float(excess[5:7, 0].min()) > 0.03
    assert float((theory - excess)[5:7, 0].abs().max()) < 0.02
    torch.testing.assert_close(result.mean.sum(-1), torch.ones(8, 4, dtype=torch.float64), rtol=0, atol=1e-9)
    # Long waves, where hardly anything has been scattered: what the mean wave takes leaves no band below zero.
    assert float(theory_transfer(disorder, 256, 32, [8.0], tones=[2]).mean.min()) > -5e-4


def test_weak_disorder_does_not_depend_on_the_law():
    times = [1.0, 16.0, 39.0, 100.0, 399.0]
    binary, normal = (theory_transfer(tc.Disorder(kind, 0.005), 64, 8, times).mean for kind in ("binary", "normal"))
    assert float(distance(binary, normal).max()) < 5e-5  # of 8e-4 that the disorder does
    assert float(distance(binary, torch.eye(8, dtype=torch.float64)[:, None]).max()) > 5e-4


def test_localization_is_what_the_ladder_lacks_at_late_times(chains):
    disorder = tc.Disorder(strength=0.2)
    whole, ladder = (theory_transfer(disorder, 64, 8, TIMES, localization=x) for x in (True, False))
    assert float(distance(whole.long_time, chains.long_time)) < 0.4 * float(
        distance(ladder.long_time, chains.long_time)
    )
    assert float(distance(whole.mean, chains.mean)[-1]) < 0.6 * float(distance(ladder.mean, chains.mean)[-1])


def test_estimated_error_covers_the_measured_one_within_a_factor(chains):
    result = theory_transfer(tc.Disorder(strength=0.2), 64, 8, TIMES)
    noise = 0.4 * chains.stderr.sum(-1).mean(0)
    error, estimate = distance(result.mean, chains.mean), result.systematic.mean(0)
    late = TIMES >= 4
    assert bool((error[late] <= 2.5 * estimate[late] + noise[late]).all())


def test_random_stiffnesses_are_the_dual_chain():
    disorder, soft = tc.Disorder(strength=0.0), tc.Disorder(strength=0.2)
    scene = tc.Scene(
        n_particles=64, n_bands=8, disorder=disorder, stiffness_disorder=soft, times=TIMES, realizations=100, seed=2
    )
    measured = tc.band_transfer(scene, starts=False)
    result = theory_transfer(disorder, 64, 8, TIMES, stiffness_disorder=soft)
    noise = 0.4 * measured.stderr.sum(-1).mean(0)
    assert bool((distance(result.mean, measured.mean) <= 0.012 + 1.5 * noise).all())
    torch.testing.assert_close(result.mean[:, 0], torch.eye(8, dtype=torch.float64), rtol=0, atol=1e-6)


def test_contact_damping_is_exact_in_the_ordered_chain():
    damping, times = 0.05, torch.tensor([0.0, 1.0, 5.0, 20.0], dtype=torch.float64)
    result = theory_transfer(tc.Disorder(strength=0.0), 64, 8, times, damping=damping)
    chain = tc.Chain(torch.ones(64, dtype=torch.float64), damping=damping)
    state = tc.standing_wave(chain, center_tones(64, 8), 0.01)
    motion = tc.evolve(chain, state, times, method="damped")
    energy = tc.band_energy(chain, motion, 8, normalize=False)
    torch.testing.assert_close(result.mean, energy / energy[:, :1].sum(-1, keepdim=True), rtol=0, atol=1e-6)


def test_damped_disordered_chains():
    scene = tc.Scene(
        n_particles=64, n_bands=8, disorder=tc.Disorder(strength=0.2), times=TIMES, realizations=100, damping=0.05
    )
    measured = tc.band_transfer(scene, starts=False)
    result = theory_transfer(tc.Disorder(strength=0.2), 64, 8, TIMES, damping=0.05)
    torch.testing.assert_close(result.mean.sum(-1), measured.mean.sum(-1), rtol=0, atol=0.003)
    assert bool((distance(result.mean, measured.mean) <= 0.01).all())


@pytest.mark.parametrize("kind", ["normal", "binary"])
def test_transfer_does_not_depend_on_how_times_are_asked_for(kind):
    disorder = tc.Disorder(kind, strength=0.3)
    many = theory_transfer(disorder, 64, 8, torch.linspace(0, 100, 11, dtype=torch.float64))
    few = theory_transfer(disorder, 64, 8, [30.0, 100.0])
    torch.testing.assert_close(many.mean[:, [3, 10]], few.mean, rtol=0, atol=1e-6)


def test_late_transfer_reaches_the_infinite_time_average():
    result = theory_transfer(tc.Disorder(strength=0.4), 32, 4, [390.0, 410.0, 1000.0])
    assert float(distance(result.mean[:, 0], result.mean[:, 1])) < 1e-3
    assert float(distance(result.mean[:, 2], result.long_time)) < 2e-3


def test_chains_at_late_times():
    scene = tc.Scene(
        n_particles=32,
        n_bands=4,
        disorder=tc.Disorder(strength=0.2),
        times=[500.0, 1000.0, 2000.0],
        realizations=400,
        seed=8,
    )
    measured = tc.band_transfer(scene, "modes", starts=False)
    result = theory_transfer(scene.disorder, 32, 4, scene.times)
    noise = 0.4 * measured.stderr.sum(-1).mean(0)
    assert bool((distance(result.mean, measured.mean) <= 0.006 + 1.5 * noise).all())


def test_far_beyond_800_the_ladder_fades_as_it_is(monkeypatch):
    disorder, times = tc.Disorder(strength=0.3), [900.0, 2000.0]
    faded = theory_transfer(disorder, 32, 4, times).mean
    monkeypatch.setattr("torchchain.theory.transfer.FADING", math.inf)
    torch.testing.assert_close(faded, theory_transfer(disorder, 32, 4, times).mean, rtol=0, atol=2e-4)


def test_one_source_is_that_of_all():
    disorder, tones = tc.Disorder(strength=0.3), center_tones(64, 8)
    one = theory_transfer(disorder, 64, 8, TIMES, tones=[tones[5]])
    torch.testing.assert_close(one.mean[0], theory_transfer(disorder, 64, 8, TIMES).mean[5], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"boundary": "fixed"}, "boundary must be 'periodic'"),
        ({"contact": "hertz"}, "contact must be 'linear'"),
        ({"stiffness_disorder": tc.Disorder(strength=0.1)}, "stiffness_disorder must be without mass disorder"),
        ({"times": [1e4], "damping": 0.01}, "times must be at most 5000"),
        ({"tones": []}, "tones must hold at least one tone"),
        ({"tones": [33]}, "tones must be at most 32"),
        ({"n_bands": 7}, "n_bands must divide"),
        ({"damping": -1.0}, "damping must be at least 0"),
    ],
)
def test_what_the_theory_does_not_hold_for_is_refused(changes, words):
    settings = {"disorder": tc.Disorder(strength=0.2), "n_particles": 64, "n_bands": 8, "times": [1.0]} | changes
    with pytest.raises(FieldError, match=words):
        theory_transfer(**settings)
