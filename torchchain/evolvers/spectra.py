"""Energies of wavenumbers and bands from the transforms of what the kernels leave behind. Imports Numba."""
# mypy: allow-untyped-defs

from __future__ import annotations

import numpy as np

from torchchain.evolvers.compiling import U, summing_kernel, wide_vectors
from torchchain.evolvers.records import KICKED_FIELDS, SITE_FIELDS, UNIFORM_FIELDS


@summing_kernel
def bin_spectra(spectra, kind, strain, normalize, row, time, bands, totals):
    """Energies of wavenumbers (Eq. 43) summed into bands (Eq. 44).

    Args:
        spectra: transforms of the fields that :func:`.stencil.propagate` leaves, without a factor, (field, row, time,
            2 (N/2 + 1)): the real and the imaginary part of each wavenumber in turn.
        kind: UNIFORM_FIELDS, SITE_FIELDS or BOND_FIELDS; KICKED_FIELDS for the motion after a kick, of which these are the
            fields of the motion after a release (see :mod:`torchchain.energy.kicked`).
        strain: stiffness 4 kappa sin^2(k / 2) of a uniform ring, twice for each wavenumber, (2 (N/2 + 1),); of KICKED_FIELDS
            its inverse, 0 at k = 0.
        normalize: divide by the total.
        row, time: where in the results the spectra belong.
        bands: (row, time, band), written.
        totals: energy of all wavenumbers, k = 0 among them, (row, time), written.
    """
    wide_vectors()
    count, size, n_bands = spectra.shape[0], spectra.shape[3], bands.shape[2]
    width = (size - 2) // n_bands
    # 1/2 for the energy and 1/N for the unitary transform; k and -k are two, except where they are one.
    scale = 1.0 / (size - 2)
    energy = np.empty(size)
    for r in range(spectra.shape[1]):
        for i in range(spectra.shape[2]):
            p, q = spectra[0, r, i], spectra[1, r, i]
            s, t = spectra[min(2, count - 1), r, i], spectra[min(3, count - 1), r, i]
            out = bands[row + r, time + i]
            if kind == UNIFORM_FIELDS:
                for k in range(size):
                    energy[k] = p[k] * q[k] + strain[k] * s[k] * s[k]
            elif kind == KICKED_FIELDS:
                for k in range(size):
                    energy[k] = s[k] * t[k] + strain[k] * q[k] * q[k]
            elif kind == SITE_FIELDS:
                for k in range(size):
                    energy[k] = p[k] * q[k] + s[k] * t[k]
            else:
                for k in range(size):
                    energy[k] = p[k] * p[k] + q[k] * q[k]
            energy[0] *= 0.5
            energy[size - 2] *= 0.5
            total = energy[0]
            for band in range(n_bands):
                part = 0.0
                start = U(2 + band * width)
                for k in range(U(width)):
                    part += energy[start + k]
                out[band] = part
                total += part
            factor = 1.0 / total if normalize else scale
            for band in range(n_bands):
                out[band] *= factor
            totals[row + r, time + i] = total * scale
