import numpy as np
import pytest
import torch
from scipy import stats

import torchchain as tc
from torchchain.chain.disorder import KINDS
from torchchain.checks import FieldError, FieldTypeError

MANY = 400_000  # values per kind: the standard error of a mean is xi / 632


def distribution(kind, xi):
    """The uncut distribution of mean 1 and standard deviation xi, from SciPy's own parameters."""
    if kind == "normal":
        return stats.norm(1, xi)
    if kind == "uniform":
        return stats.uniform(1 - np.sqrt(3) * xi, 2 * np.sqrt(3) * xi)
    if kind == "lognormal":
        sigma = np.sqrt(np.log(1 + xi**2))
        return stats.lognorm(sigma, scale=np.exp(-(sigma**2) / 2))
    return stats.gamma(1 / xi**2, scale=xi**2)


def sample(disorder, seed=3):
    return disorder.masses(1000, MANY // 1000, seed).flatten().numpy()


def test_known_values():
    # Computed once and pinned: results of years ago must be reproducible.
    masses = tc.Disorder().masses(3, 2, 0)
    expected = [[0.3257950264, 0.7901635841, 0.6353865295], [1.2672581152, 1.2037871993, 1.1335515395]]
    np.testing.assert_allclose(masses.numpy(), expected, atol=1e-9)
    stiffnesses = tc.Disorder("gamma", 0.5).stiffnesses(2, [10**12], 2**64 - 1)
    assert stiffnesses.shape == (1, 2)
    np.testing.assert_allclose(stiffnesses.numpy(), [[1.0555316891, 0.5538834626]], atol=1e-9)


def test_values_come_from_philox():
    # The generator of NumPy, keyed by (seed, realization), through SciPy's inverse of the cut distribution.
    xi, lower = 0.5, 0.05
    masses = tc.Disorder("normal", xi, lower).masses(50, [4], 11)[0].numpy()
    words = np.random.Philox(key=[11, 4]).random_raw(50)
    uniform = ((words >> 11) + 0.5) / 2**53
    expected = stats.truncnorm((lower - 1) / xi, np.inf, 1, xi).ppf(uniform)
    np.testing.assert_allclose(masses, expected, rtol=1e-12)


def test_masses_do_not_depend_on_chunks_order_or_length():
    disorder = tc.Disorder("lognormal", 0.4)
    whole = disorder.masses(40, 7, seed=5)
    assert torch.equal(disorder.masses(40, [6, 2, 2, 0], 5), whole[[6, 2, 2, 0]])
    assert torch.equal(torch.cat([disorder.masses(40, range(a, a + 1), 5) for a in range(7)]), whole)
    assert torch.equal(disorder.masses(13, 7, 5), whole[:, :13])
    assert torch.equal(disorder.masses(40, 3, 5), whole[:3])


@pytest.mark.parametrize("kind", KINDS)
def test_opposite_pairs(kind):
    disorder = tc.Disorder(kind, 0.3, 0.0)
    pairs = disorder.masses(50, 8, 5, opposite_pairs=True).reshape(4, 2, 50)
    assert torch.equal(pairs[:, 0], disorder.masses(50, 4, 5))  # the plain realizations, and their opposites
    if kind == "binary":
        assert torch.allclose(pairs.sum(1), torch.full((4, 50), 2.0, dtype=torch.float64), rtol=0, atol=1e-15)
        return
    cut = distribution(kind, 0.3).cdf(0.0)  # 0 but for the normal distribution
    ranks = (distribution(kind, 0.3).cdf(pairs.numpy()) - cut) / (1 - cut)
    np.testing.assert_allclose(ranks.sum(1), 1, rtol=0, atol=1e-12)
    contacts = disorder.stiffnesses(50, 8, 5, opposite_pairs=True)
    assert torch.equal(contacts[0::2], disorder.stiffnesses(50, 4, 5))
    assert torch.equal(disorder.masses(50, [3, 2], 5, opposite_pairs=True), pairs[1].flip(0))


def test_seeds_realizations_and_streams_differ():
    disorder = tc.Disorder()
    drawn = torch.cat([disorder.masses(20, 3, 0), disorder.masses(20, 3, 1), disorder.stiffnesses(20, 3, 0)])
    assert len(torch.unique(drawn)) == drawn.numel()


def test_masses_and_stiffnesses_are_uncorrelated():
    disorder = tc.Disorder("uniform", 0.3)
    a, b = disorder.masses(1000, 200, 0).flatten(), disorder.stiffnesses(1000, 200, 0).flatten()
    # The correlation of independent values has the standard error 1 / sqrt(count).
    for shift in (0, 1, 4):
        correlation = np.corrcoef(a.numpy(), np.roll(b.numpy(), shift))[0, 1]
        assert abs(correlation) < 4 / np.sqrt(len(a))


def test_neighbors_are_uncorrelated():
    a = sample(tc.Disorder("normal", 0.3))
    for lag in (1, 2, 4):
        assert abs(np.corrcoef(a[:-lag], a[lag:])[0, 1]) < 4 / np.sqrt(len(a))


@pytest.mark.parametrize("xi", [0.1, 0.3, 0.5])
@pytest.mark.parametrize("kind", ["normal", "uniform", "lognormal", "gamma"])
def test_distribution(kind, xi):
    lower = 0.4
    disorder = tc.Disorder(kind, xi, lower)
    whole = distribution(kind, xi)
    below = whole.cdf(lower)
    assert disorder.redrawn_fraction == pytest.approx(below, rel=1e-9, abs=1e-15)
    values = sample(disorder)
    assert values.min() >= lower

    def cut(x):
        return np.clip((whole.cdf(x) - below) / (1 - below), 0, 1)

    # Kolmogorov and Smirnov: the largest distance exceeds 1.95 / sqrt(n) once in a thousand seeds; this seed is fixed.
    assert stats.kstest(values, cut).statistic < 1.95 / np.sqrt(len(values))


@pytest.mark.parametrize("kind", KINDS)
def test_moments_without_a_cut(kind):
    xi = 0.3
    values = sample(tc.Disorder(kind, xi, 0.0))
    # At xi = 0.3 the cut at 0 removes 4e-4 of a normal distribution and less of the others.
    kurtosis = {"binary": 1.0, "uniform": 1.8}.get(kind, 6.0)
    assert values.mean() == pytest.approx(1, abs=4 * xi / np.sqrt(MANY) + 1.5e-3 * (kind == "normal"))
    assert values.std() == pytest.approx(
        xi, rel=4 * np.sqrt((kurtosis - 1 + 0.01) / 4 / MANY) + 5e-3 * (kind == "normal")
    )


def test_truncated_normal_in_closed_form():
    xi, lower = 0.5, 0.05
    a = (lower - 1) / xi
    ratio = stats.norm.pdf(a) / stats.norm.sf(a)  # the inverse Mills ratio
    mean, variance = 1 + xi * ratio, xi**2 * (1 + a * ratio - ratio**2)
    values = sample(tc.Disorder("normal", xi, lower))
    assert values.mean() == pytest.approx(mean, abs=4 * np.sqrt(variance / MANY))
    assert values.std() == pytest.approx(np.sqrt(variance), rel=4 * np.sqrt(0.5 / MANY))  # near-normal: 2 / (4 n)
    # The cut matters: 2.9 % are drawn again and the mean shifts by 0.034, 40 of its standard errors.
    assert tc.Disorder("normal", xi, lower).redrawn_fraction == pytest.approx(stats.norm.cdf(a), rel=1e-12)
    assert mean - 1 > 0.03


def test_binary_values():
    values = sample(tc.Disorder("binary", 0.3))
    assert set(np.unique(values)) == {0.7, 1.3}
    assert tc.Disorder("binary", 0.3).redrawn_fraction == 0
    assert abs((values == 0.7).mean() - 0.5) < 4 * 0.5 / np.sqrt(MANY)


@pytest.mark.parametrize("kind", KINDS)
def test_the_rarest_draws(kind):
    # The smallest and the largest number that 53 random bits give, which no sample will show.
    for lower in np.linspace(0.01, 0.65, 40):
        for xi in (0.3, 3.0):
            if kind == "binary" and xi > 1 - lower:
                continue
            ends = tc.Disorder(kind, xi, lower)._quantile(np.array([0.0, 2.0**-54, 1 - 2.0**-53, 1.0]))
            assert np.isfinite(ends).all()
            assert ends.min() >= lower


@pytest.mark.parametrize("xi", [0.0, 1e-300, 1e-200, 1e-20])
@pytest.mark.parametrize("kind", KINDS)
def test_no_disorder(kind, xi):
    disorder = tc.Disorder(kind, xi)
    assert disorder.redrawn_fraction == 0
    assert torch.equal(disorder.masses(8, 2, 0), torch.ones(2, 8, dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_strength_scales_the_same_draws_when_weak(kind):
    # To first order in xi the value is 1 + xi times a number that does not depend on xi.
    one, ten = (tc.Disorder(kind, xi).masses(100, 1, 0) for xi in (1e-7, 1e-6))
    assert torch.allclose((ten - 1) / 10, one - 1, rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize(
    ("fields", "error", "message"),
    [
        ({"kind": "cauchy"}, FieldError, "disorder.kind must be one of .*'cauchy'"),
        ({"kind": 3}, FieldTypeError, "disorder.kind must be a string"),
        ({"strength": -0.1}, FieldError, "disorder.strength must be at least 0, got -0.1"),
        ({"strength": 11}, FieldError, "disorder.strength must be at most 10"),
        ({"strength": float("nan")}, FieldError, "disorder.strength must be finite"),
        ({"strength": 10**400}, FieldError, "disorder.strength must be finite"),
        ({"strength": True}, FieldTypeError, "disorder.strength must be a number, got True"),
        ({"strength": "0.3"}, FieldTypeError, "disorder.strength must be a number"),
        ({"lower": 1.0}, FieldError, "disorder.lower must be less than 1"),
        ({"lower": -1e-9}, FieldError, "disorder.lower must be at least 0"),
        ({"lower": None}, FieldTypeError, "disorder.lower must be a number"),
        ({"kind": "binary", "strength": 0.96}, FieldError, "disorder.strength must be less than 1 - lower = 0.95"),
    ],
)
def test_bad_fields(fields, error, message):
    with pytest.raises(error, match=message):
        tc.Disorder(**fields)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((0, 1, 0), FieldError, "n_particles must be at least 1"),
        ((4.0, 1, 0), FieldTypeError, "n_particles must be an integer"),
        ((4, 0, 0), FieldError, "realizations must be at least 1"),
        ((4, [-1], 0), FieldError, "realizations must be at least 0"),
        ((4, [1.5], 0), FieldTypeError, "realizations must be an integer"),
        ((4, "ab", 0), FieldTypeError, "realizations must be an integer"),
        ((4, torch.tensor(2), 0), FieldTypeError, "realizations must be an integer"),
        ((4, None, 0), FieldTypeError, "realizations must be an integer"),
        ((4, 1, -1), FieldError, "seed must be at least 0"),
        ((4, 1, 2**64), FieldError, "seed must be at most"),
        ((4, 1, True), FieldTypeError, "seed must be an integer"),
    ],
)
def test_bad_arguments(arguments, error, message):
    with pytest.raises(error, match=message):
        tc.Disorder().masses(*arguments)
