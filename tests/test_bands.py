import numpy as np
import pytest
import torch
from literal import bands

import torchchain as tc
from torchchain.checks import FieldError, FieldTypeError
from torchchain.energy.bands import band_of, center_tones, check_bands


def test_the_papers_tones():
    assert center_tones(256, 32) == tuple(range(2, 127, 4))


@pytest.mark.parametrize(("n", "n_bands"), [(256, 32), (24, 4), (24, 12), (24, 1), (10, 5), (4, 2), (2, 1), (12, 3)])
def test_tones_and_bands(n, n_bands):
    # Band r holds the wavenumbers (r - 1) pi / B < k <= r pi / B.
    for tone in range(1, n // 2 + 1):
        k = 2 * tone / n  # in units of pi, exact comparison by cross multiplication
        r = band_of(tone, n, n_bands)
        assert (r - 1) * n < 2 * tone * n_bands <= r * n, (tone, r, k)
    centers = center_tones(n, n_bands)
    assert [band_of(tone, n, n_bands) for tone in centers] == list(range(1, n_bands + 1))
    for r, tone in enumerate(centers, start=1):  # within half a tone of (r - 1/2) N / (2 B)
        assert 0 <= tone - (r - 0.5) * n / (2 * n_bands) <= 0.5


@pytest.mark.parametrize(("n", "n_bands"), [(24, 4), (24, 12), (24, 1), (10, 5)])
def test_bin_energy(n, n_bands):
    energy = torch.rand(2, 3, n // 2 + 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    binned = tc.bin_energy(energy, n_bands)
    assert binned.shape == (2, 3, n_bands)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(binned[i, j].numpy(), bands(energy[i, j].numpy(), n_bands), rtol=1e-14)


@pytest.mark.parametrize(
    ("n", "n_bands", "error", "message"),
    [
        (8, 0, FieldError, "n_bands must be at least 1"),
        (8, 3, FieldError, "n_bands must divide the number of tones n_particles/2 = 4, got 3"),
        (8, 5, FieldError, "n_bands must be at most the number of tones n_particles/2 = 4, got 5"),
        (7, 1, FieldError, "n_particles must be even for wavenumber bands, got 7"),
        (8, 2.0, FieldTypeError, "n_bands must be an integer"),
        (8, True, FieldTypeError, "n_bands must be an integer"),
    ],
)
def test_bad_bands(n, n_bands, error, message):
    with pytest.raises(error, match=message):
        check_bands(n, n_bands)
