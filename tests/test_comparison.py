"""Two results against each other."""

import math

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.ensemble.comparison import compare, z_scores


def scene(seed=0, **fields):
    given = {"n_particles": 64, "n_bands": 8, "realizations": 60, "times": torch.arange(0.0, 21.0, 1.0), "seed": seed}
    return tc.Scene(**{**given, **fields})


@pytest.fixture(scope="module")
def results():
    return [tc.simulate(scene(seed), "modes") for seed in (0, 1)]


def test_a_result_agrees_with_itself(results):
    (found,) = compare(results[0], results[0])
    assert (found.variable, found.largest_difference, found.largest_z, found.within_one) == ("band_energy", 0, 0, 1)
    assert found.n_values == results[0]["band_energy"].size


def test_two_samples_of_one_ensemble(results):
    (found,) = compare(*results)
    # z is a t-like number of 60 realizations each; energies of one source and time are correlated, hence the width.
    assert 0.7 < found.rms_z < 1.35
    assert 0.55 < found.within_one < 0.82
    assert 0.6 < found.total_variation / found.expected_distance < 1.5


def test_a_difference_is_found(results):
    moved = results[1].copy(deep=True)
    moved["band_energy"] = moved["band_energy"] + 5 * moved["band_energy_stderr"]
    (found,) = compare(results[0], moved)
    assert found.rms_z > 3
    z = z_scores(results[0], moved, "band_energy")
    expected = (results[0].band_energy - moved.band_energy) / np.hypot(
        results[0].band_energy_stderr, moved.band_energy_stderr
    )
    assert float(abs(z - expected).max()) < 1e-12


def test_only_common_times_are_compared(results):
    later = results[1].sel(time=slice(5, 10))
    (found,) = compare(results[0], later)
    assert found.n_values == later["band_energy"].size


def test_rounding_is_no_error(results):
    one = results[0].assign(band_energy_stderr=0 * results[0].band_energy + 1e-18)
    (found,) = compare(one, one.assign(band_energy=one.band_energy + 1e-15))
    assert found.largest_difference > 0
    assert math.isnan(found.rms_z)


def test_results_without_errors(results):
    bare = results[0].drop_vars("band_energy_stderr")
    (found,) = compare(bare, bare)
    assert math.isnan(found.rms_z)
    assert found.total_variation == 0
    assert "z-score" not in str(found)


def test_results_that_cannot_be_compared(results):
    with pytest.raises(FieldError, match="hold an observable that both have"):
        compare(results[0], results[0][["band_energy_stderr"]])
    with pytest.raises(FieldError, match="have coordinates in common"):
        compare(results[0].sel(time=[1.0]), results[1].sel(time=[2.0]))
    with pytest.raises(FieldError, match="have the axes"):
        compare(results[0], results[1].isel(tone=0))
