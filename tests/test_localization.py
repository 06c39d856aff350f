import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError

BAND_CENTER = 8 * (math.gamma(0.75) / math.gamma(0.25)) ** 2  # 0.9139, Derrida and Gardner 1984


def squared_frequencies(masses, contacts, ring):
    """Eigenvalues of M^-1/2 (-K) M^-1/2 of one chain, from a dense matrix filled contact by contact."""
    n = len(masses)
    stiffness = np.zeros((n, n))
    for i, kappa in enumerate(
        contacts
    ):  # contact i joins particles i - 1 and i; beyond the ends of a fixed chain are walls
        here, left = i % n, (i - 1) % n
        if ring:
            difference = np.zeros(n)
            difference[here] += 1
            difference[left] -= 1
        else:
            difference = np.zeros(n + 2)
            difference[[i, i + 1]] = -1, 1
            difference = difference[1:-1]
        stiffness += kappa * np.outer(difference, difference)
    root = np.sqrt(masses)
    return np.linalg.eigvalsh(stiffness / root / root[:, None])


@pytest.mark.parametrize("disordered", ["masses", "stiffness", "both", "neither"])
@pytest.mark.parametrize("boundary", ["fixed", "periodic"])
@pytest.mark.parametrize("n", [2, 3, 40])
def test_sturm_counts_equal_eigenvalue_counts(boundary, disordered, n):
    n_contacts = n + (boundary == "fixed")
    kinds = {"masses": ("normal", 0), "stiffness": (0, "gamma"), "both": ("binary", "uniform"), "neither": (0, 0)}[
        disordered
    ]
    disorder, stiffness = (tc.Disorder(kind or "normal", 0.4 if kind else 0.0) for kind in kinds)
    masses, contacts = disorder.masses(n, 4, 1), stiffness.stiffnesses(n_contacts, 4, 1)
    chain = tc.Chain(masses, boundary, contacts)
    exact = [
        squared_frequencies(m, k, boundary == "periodic") for m, k in zip(masses.numpy(), contacts.numpy(), strict=True)
    ]
    # Halfway between neighboring eigenvalues of all chains, where they are far enough apart for rounding to have no say.
    every = np.sort(np.concatenate([[0.0], *exact]))
    gaps = np.diff(every)
    between = ((every[1:] + every[:-1]) / 2)[gaps > 1e-10]
    w = torch.from_numpy(np.sqrt(np.append(between, 100.0)))
    expected = np.array([[(values < x**2).sum() for x in w.numpy()] for values in exact])
    np.testing.assert_array_equal(tc.count_modes_below(chain, w).numpy(), expected)


def test_counts_of_long_chains_equal_eigenvalue_counts():
    chain = tc.Chain(tc.Disorder(strength=0.3).masses(300, 3, 0), "fixed")
    w = torch.linspace(0.01, 3, 97, dtype=torch.float64)
    frequencies = tc.normal_modes(chain).frequencies
    assert (frequencies[..., None] - w).abs().min() > 1e-9
    expected = (frequencies[..., None] < w).sum(-2)
    assert torch.equal(tc.count_modes_below(chain, w), expected)


def test_counts_start_at_zero_and_end_at_the_number_of_particles():
    chain = tc.Chain(tc.Disorder("gamma", 0.5).masses(25, 6, 0).reshape(2, 3, 25), "periodic")
    counts = tc.count_modes_below(chain, [0.0, 0.5, 1.0, 2.0, 100.0])
    assert counts.shape == (2, 3, 5)
    assert (counts[..., 0] == 0).all()
    assert (counts[..., -1] == 25).all()
    assert (counts.diff(dim=-1) >= 0).all()


def test_density_of_states_of_long_waves():
    # N(w) = sqrt(<b>) w / pi for w to 0 (Dyson 1953), with w^2 / 24 for the lattice; a count is whole, half a mode in N.
    w, n = torch.tensor([0.1, 0.2]), 4096
    states = tc.integrated_density_of_states(tc.Disorder(strength=0.3), w, n, 10)
    expected = w.double() / math.pi * (1 + w.double() ** 2 / 24)
    error = 3 * states.stderr + 0.5 / n + 0.3**2 * w.double() ** 3 / math.pi  # disorder enters with xi^2 w^2
    assert ((states.value - expected).abs() < error).all()


def test_lyapunov_exponent_of_weak_disorder():
    # Matsuda and Ishii 1970. The start (u, T) = (1, 0) has no effect beyond the swing of the logarithm of the
    # ellipse's axes, ln(2 / w) over the length of the chain; the next order of the formula is xi^2 itself.
    n, xi = 10_000, 0.1
    w = torch.tensor([0.8, 1.0, 1.2, 1.6], dtype=torch.float64)
    measured, weak = tc.lyapunov_exponent(tc.Disorder(strength=xi), w, n), tc.weak_disorder_lyapunov(xi, w)
    bias = (2 / w).log() / n + 2 * xi**2 * weak
    assert ((measured.value - weak).abs() < 3 * measured.stderr + bias).all()
    assert (measured.stderr < 0.06 * weak).all()  # so that the line above says something


def test_lyapunov_exponent_at_the_band_center():
    # At w = sqrt(2), k = pi / 2, second-order theory fails however weak the disorder is: Anderson's band-center anomaly.
    w = torch.tensor([math.sqrt(2)], dtype=torch.float64)
    measured = tc.lyapunov_exponent(tc.Disorder(strength=0.2), w, 20_000, 50)
    ratio, error = (
        measured.value / tc.weak_disorder_lyapunov(0.2, w),
        measured.stderr / tc.weak_disorder_lyapunov(0.2, w),
    )
    assert abs(ratio - BAND_CENTER) < 3 * error + 0.2**2 / 4
    assert ratio < 0.95


def test_lyapunov_exponent_is_the_growth_of_the_transfer_matrices():
    masses = tc.Disorder("lognormal", 0.5).masses(400, 3, 2).numpy()
    w = 1.3
    expected = []
    for chain in masses:
        previous, here = 1.0, 1.0  # T = 0 before the first particle: u_1 = u_0
        for mass in chain:
            previous, here = here, (2 - w**2 * mass) * here - previous
        expected.append(math.log(math.hypot(here, here - previous)) / len(chain))
    measured = tc.lyapunov_exponent(tc.Disorder("lognormal", 0.5), [w], 400, 3, 2)
    assert measured.value.item() == pytest.approx(np.mean(expected), rel=1e-12)
    assert measured.stderr.item() == pytest.approx(np.std(expected, ddof=1) / math.sqrt(3), rel=1e-10)


def test_lyapunov_exponent_of_the_ordered_chain():
    # Nothing localizes inside the band; beyond it waves are evanescent, cosh(gamma) = w^2 / 2 - 1.
    n = 2000
    ordered = tc.lyapunov_exponent(tc.Disorder(strength=0.0), [0.3, 1.0, 1.9, 2.1, 3.0], n, 2)
    assert (ordered.value[:3].abs() < 5 / n).all()
    expected = torch.acosh(torch.tensor([2.1, 3.0], dtype=torch.float64) ** 2 / 2 - 1)
    assert ((ordered.value[3:] - expected).abs() < 2 / n).all()


def test_softness_localizes_as_mass_does():
    # The recursion treats b and 1 / kappa alike: weak disorder of either with the same variance, the same exponent.
    xi, w = 0.1, torch.tensor([1.0], dtype=torch.float64)
    ordered = tc.Disorder(strength=0.0)
    measured = tc.lyapunov_exponent(ordered, w, 10_000, 50, stiffness_disorder=tc.Disorder(strength=xi))
    weak = tc.weak_disorder_lyapunov(xi, w)
    assert abs(measured.value - weak) < 3 * measured.stderr + 6 * xi**2 * weak  # sd of 1 / kappa is xi (1 + 4 xi^2)


def test_energy_falls_off_with_the_lyapunov_exponent():
    # A single mode decays as exp(-gamma n) from its center, its energy twice as fast: fitted beyond the center of many modes.
    xi, n = 0.5, 400
    modes = tc.normal_modes(tc.Chain(tc.Disorder(strength=xi).masses(n, 20, 0), "fixed"))
    chosen = (modes.frequencies > 1.35) & (modes.frequencies < 1.45)
    shapes = modes.shapes.transpose(-1, -2)[chosen].abs()  # (mode, particle)
    slopes = []
    for shape in shapes:
        peak = int(shape.argmax())
        if peak < n - 150:
            tail = (shape[peak + 20 : peak + 140] + 1e-300).log()
            tail = tail[tail > math.log(1e-12)]
            if len(tail) > 60:
                slopes.append(-np.polyfit(np.arange(len(tail)), tail.numpy(), 1)[0])
    gamma = tc.lyapunov_exponent(tc.Disorder(strength=xi), [1.4], 10_000, 20).value.item()
    error = np.std(slopes) / math.sqrt(len(slopes))
    assert len(slopes) > 20
    assert np.mean(slopes) == pytest.approx(gamma, abs=4 * error)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: tc.lyapunov_exponent(tc.Disorder(), [-0.1]), FieldError, "frequencies must not be negative, got -0.1"),
        (lambda: tc.lyapunov_exponent(tc.Disorder(), [[0.1]]), FieldError, "frequencies must be one-dimensional"),
        (lambda: tc.lyapunov_exponent(tc.Disorder(), ["a"]), FieldTypeError, "frequencies"),
        (lambda: tc.lyapunov_exponent(tc.Disorder(), [1.0], realizations=1), FieldError, "realizations must be at least 2, got 1"),
        (lambda: tc.lyapunov_exponent(tc.Disorder(), [1.0], n_particles=0), FieldError, "n_particles must be at least 1, got 0"),
        (lambda: tc.weak_disorder_lyapunov(-0.1, [1.0]), FieldError, "strength must be at least 0, got -0.1"),
        (lambda: tc.weak_disorder_lyapunov(0.1, [2.0]), FieldError, r"frequencies must lie in \[0, 2\), got 2"),
        (lambda: tc.weak_disorder_lyapunov(0.1, [math.nan]), FieldError, "frequencies must .*nan"),
        (lambda: tc.count_modes_below(tc.Chain(torch.ones(4)), [-1.0]), FieldError, "frequencies must not be negative, got -1"),
        (lambda: tc.count_modes_below(tc.Chain(torch.ones(4)), 1.0), FieldError, "frequencies must be one-dimensional"),
        (lambda: tc.integrated_density_of_states(tc.Disorder(), [1.0], 16, 1), FieldError, "realizations must be at least 2"),
    ],
)  # fmt: skip
def test_bad_arguments(call, error, message):
    with pytest.raises(error, match=message):
        call()
