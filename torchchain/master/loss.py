"""Energy left in damped chains: a mixture of damped modes, each of whose decays is known.

Contacts that damp alike leave the modes of a chain apart: q'' + c w^2 q' + w^2 q = 0, where c is the damping of a contact of
stiffness 1. What is left of the energy of a start is a sum over frequencies w, with weights that are not negative, of what is
left of one mode. So it is never negative, never grows, and starts as flat as that of chains released from rest.
"""

from __future__ import annotations

import numpy as np
import scipy

MODES = 48  # frequencies of the mixture
FASTEST = 4.0
"""Frequencies of the mixture, up to that of the lightest particles."""


def frequencies(modes: int = MODES) -> np.ndarray:
    """w of the mixture, (mode,), denser at low ones."""
    return FASTEST * ((np.arange(modes) + 0.5) / modes) ** 1.5


def mode_energy(frequency: np.ndarray, damping: float, times: np.ndarray) -> np.ndarray:
    """Share of its energy that is left of a mode released from rest, (time, mode).

    Args:
        frequency: w, (mode,).
        damping: c, of a contact of stiffness 1.
        times: (time,).
    """
    w, t = frequency.astype(complex), times[:, None]
    half = damping * w**2 / 2
    root = np.sqrt(half**2 - w**2)
    root = np.where(np.abs(root) < 1e-7 * np.abs(w), 1e-7 * w, root)  # of critical damping the limit
    slow, fast = root - half, -root - half
    first, second = np.exp(slow * t), np.exp(fast * t)
    place = (slow * second - fast * first) / (slow - fast)
    speed = slow * fast * (second - first) / (slow - fast)
    return (np.abs(place) ** 2 + np.abs(speed / w) ** 2).real


def mixture(left: np.ndarray, damping: float, times: np.ndarray) -> np.ndarray:
    """Weights of the modes, (source, mode), not negative and of sum 1, by least squares relative to what is left.

    Args:
        left: share of the energy that is left, (source, time).
        damping: c.
        times: (time,).
    """
    parts = mode_energy(frequencies(), damping, times)
    found = np.empty((len(left), parts.shape[1]))
    for source, values in enumerate(left):
        weight = 1 / np.maximum(values, 1e-3)
        rows = np.vstack(
            [parts * weight[:, None], np.full(parts.shape[1], 1e4)]
        )  # the last row: all of it at the start
        found[source], _ = scipy.optimize.nnls(rows, np.append(values * weight, 1e4))
    return found / found.sum(1, keepdims=True)
