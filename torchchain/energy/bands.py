"""Wavenumber bands: B equal bands of |k| in (0, pi], and the tones in them (Section 3.3)."""

from __future__ import annotations

import math

from torch import Tensor

from torchchain import checks


def check_bands(n_particles: int, n_bands: int) -> int:
    """The number of tones per band; an error unless the N/2 tones divide evenly into the bands.

    Raises:
        FieldError: saying which numbers of bands would do.

    Example:
        >>> tc.energy.check_bands(256, 32)
        4
    """
    n_bands = checks.integer("n_bands", n_bands, 1)
    if n_particles % 2:
        raise checks.fail("n_particles", "be even for wavenumber bands", n_particles)
    if n_bands > n_particles // 2:
        raise checks.fail("n_bands", f"be at most the number of tones n_particles/2 = {n_particles // 2}", n_bands)
    if (n_particles // 2) % n_bands:
        tones = n_particles // 2
        fewer = next(b for b in range(n_bands, 0, -1) if tones % b == 0)
        more = next(b for b in range(n_bands, tones + 1) if tones % b == 0)
        raise checks.fail(
            "n_bands", f"divide the number of tones n_particles/2 = {tones}", f"{n_bands} ({fewer} and {more} do)"
        )
    return n_particles // 2 // n_bands


def center_tones(n_particles: int, n_bands: int) -> tuple[int, ...]:
    """The center tone of every band, (s - 1/2) N / (2 B) rounded up to an integer.

    Example:
        >>> tc.energy.center_tones(256, 32)[:3]
        (2, 6, 10)
    """
    width = n_particles // (2 * n_bands)
    return tuple(math.ceil((2 * band - 1) * width / 2) for band in range(1, n_bands + 1))


def band_of(tone: int, n_particles: int, n_bands: int) -> int:
    """The band, counted from 1, that holds a tone: ceil(tone / (N / 2 / B)).

    Args:
        tone: counted from 1.
        n_particles: N, even.
        n_bands: B, a divisor of N/2.

    Example:
        >>> tc.energy.band_of(90, n_particles=256, n_bands=32)
        23
    """
    return -(-tone // check_bands(n_particles, n_bands))


def bin_energy(energy: Tensor, n_bands: int) -> Tensor:
    """Energies of N//2 + 1 wavenumbers summed into bands (Eq. 44): tone n lies in band ceil(n B / (N/2)), k = 0 in none.

    Args:
        energy: (*batch, wavenumber), the first wavenumber being k = 0.
        n_bands: B, a divisor of N/2.

    Returns:
        (*batch, band).

    Example:
        >>> tc.bin_energy(torch.tensor([9.0, 1.0, 2.0, 3.0, 4.0]), n_bands=2).tolist()
        [3.0, 7.0]
    """
    energy = checks.real_tensor("energy", energy)
    if energy.ndim == 0:
        raise checks.fail("energy", "have wavenumbers on its last axis", "shape ()")
    tones = energy.shape[-1] - 1
    width = check_bands(2 * tones, n_bands)
    return energy[..., 1:].reshape(*energy.shape[:-1], n_bands, width).sum(-1)
