"""Rates and basis energies made of random numbers, which tests calibrate and solve."""

import numpy as np


def conserving_rates(n_bands, seed=0, top=0.1, least=0.2):
    """Rates between bands from ``least`` times ``top`` to nearly that and ``top``, far from symmetric, rows summing to zero."""
    rates = top * (least + np.random.default_rng(seed).random((n_bands, n_bands)))
    np.fill_diagonal(rates, 0)
    return rates - np.diag(rates.sum(1))


def basis_matrix(n_bands, seed=1):
    """Shares that stay, rows that sum to 0.6."""
    return 0.6 * np.random.default_rng(seed).dirichlet(np.ones(n_bands), n_bands)
