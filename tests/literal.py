"""The paper's equations written out in plain NumPy and SciPy: slow, and independent of torchchain."""

import numpy as np
import scipy.linalg


def stiffness_matrix(stiffness, n, boundary):
    """K of Eq. 13 contact by contact: contact c pulls particles c - 1 and c together."""
    matrix = np.zeros((n, n))
    for contact, kappa in enumerate(stiffness):
        left, right = contact - 1, contact
        if boundary == "periodic":
            left %= n
        for a, b in ((left, right), (right, left)):
            if 0 <= a < n:
                matrix[a, a] -= kappa
                if 0 <= b < n:
                    matrix[a, b] += kappa
    return matrix


def modes(masses, matrix):
    """Frequencies and mass-normalized shapes of M u'' = K u by the generalized eigen-solver."""
    squared, shapes = scipy.linalg.eigh(-matrix, np.diag(masses))
    frequencies = np.sqrt(np.maximum(squared, 0))
    frequencies[frequencies < 1e-6] = 0  # the zero mode of a ring, to the solver's rounding
    return frequencies, shapes


def states(masses, matrix, displacement, velocity, times):
    """Displacement and velocity (time, particle) mode by mode (Eqs. 20-28), the zero mode drifting."""
    frequencies, shapes = modes(masses, matrix)
    u, v = np.zeros((len(times), len(masses))), np.zeros((len(times), len(masses)))
    for w, s in zip(frequencies, shapes.T, strict=True):
        a, b = s @ (masses * displacement), s @ (masses * velocity)
        for i, t in enumerate(times):
            if w == 0:
                u[i] += (a + b * t) * s
                v[i] += b * s
            else:
                u[i] += (a * np.cos(w * t) + b / w * np.sin(w * t)) * s
                v[i] += (b * np.cos(w * t) - a * w * np.sin(w * t)) * s
    return u, v


def dft(n):
    """The unitary transform, F F^H = 1."""
    index = np.arange(n)
    return np.exp(-2j * np.pi * np.outer(index, index) / n) / np.sqrt(n)


def wavenumber_energy(total):
    """Energy at |k| = 2 pi (0..n/2) / n from the matrix TE: the diagonal of DFT TE DFT^-1 (Eq. 42), k and -k added."""
    n = len(total)
    forward = dft(n)
    diagonal = np.diag(forward @ total @ np.linalg.inv(forward))
    folded = np.zeros(n // 2 + 1, dtype=complex)
    for k in range(n):
        folded[min(k, n - k)] += diagonal[k]
    return folded


def bands(energy, n_bands):
    """Energies of tones 0..n/2 in bands: tone m lies in the band r with (r - 1) < m / width <= r (Eq. 44)."""
    tones = len(energy) - 1
    out = np.zeros(n_bands)
    for tone in range(1, tones + 1):
        r = 1
        while tone * n_bands > r * tones:
            r += 1
        out[r - 1] += energy[tone]
    return out


def band_energy(masses, matrix, u, v, n_bands):
    """Normalized band energies of one state by the literal Eqs. 29, 32, 35, 42-46."""
    kinetic = np.diag(masses) @ np.outer(v, v) / 2
    potential = -matrix @ np.outer(u, u) / 2
    energy = wavenumber_energy(kinetic + potential)
    assert abs(energy.imag).max() < 1e-12 * abs(energy).max()  # k and -k are complex conjugates
    return bands(energy.real, n_bands) / energy.real.sum()


def long_time_band_energy(masses, matrix, displacement, velocity, n_bands):
    """Infinite-time average of the normalized band energies: pairs of modes of one frequency do not average out."""
    frequencies, shapes = modes(masses, matrix)
    moving, resting = np.zeros_like(matrix), np.zeros_like(matrix)  # averages of v v^T and u u^T
    for i, wi in enumerate(frequencies):
        for j, wj in enumerate(frequencies):
            if abs(wi - wj) > 1e-9:
                continue
            si, sj = shapes[:, i], shapes[:, j]
            ai, aj = si @ (masses * displacement), sj @ (masses * displacement)
            bi, bj = si @ (masses * velocity), sj @ (masses * velocity)
            if wi == 0:
                moving += bi * bj * np.outer(si, sj)
                continue
            resting += (ai * aj + bi * bj / wi**2) / 2 * np.outer(si, sj)
            moving += (wi**2 * ai * aj + bi * bj) / 2 * np.outer(si, sj)
    energy = wavenumber_energy((np.diag(masses) @ moving - matrix @ resting) / 2).real
    return bands(energy, n_bands) / energy.sum()
