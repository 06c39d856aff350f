"""A law of disorder as a short quadrature: means over the law of functions that are analytic on its support."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import special
from torch import Tensor

from torchchain import checks
from torchchain.chain import Disorder

_TAIL = 1e-17  # probability left out beyond the last node
_POINTS = 400  # of the fine rule that the short one is made from


@dataclass(frozen=True, eq=False)
class Law:
    """Values and weights, each (node,): ``(weights * f(values)).sum()`` is the mean of f over the law.

    Attributes:
        values: positive.
        weights: positive, of sum 1.

    Example:
        >>> law = tc.theory.law_of(tc.Disorder(strength=0.3))
        >>> abs((law.weights * law.values).sum().item() - 1) < 0.01
        True
    """

    values: Tensor
    weights: Tensor

    def moment(self, power: float) -> float:
        """Mean of value**power."""
        return float((self.weights * self.values**power).sum().detach())

    @property
    def mean(self) -> float:
        """Mean value, 1 but for the shift by the cut at ``lower``."""
        return self.moment(1)

    @property
    def variance(self) -> float:
        """Variance, strength**2 but for the cut at ``lower``."""
        return float((self.weights * (self.values - self.mean) ** 2).sum().detach())

    def inverse(self) -> Law:
        """The law of 1 / value."""
        return Law(1 / self.values, self.weights)


def law_of(disorder: Disorder, nodes: int = 48, strength: Tensor | None = None) -> Law:
    """The law of a :class:`Disorder`, cut off at ``lower``, as a Gauss rule of its own.

    The density is laid on a fine Gauss-Legendre grid (in the logarithm for lognormal and gamma laws) and shortened by
    the Lanczos process to the Gauss rule with the same first 2 ``nodes`` moments (Golub and Welsch 1969).

    Args:
        disorder: kind, strength and lower cut.
        nodes: of the short rule; fewer where the law has fewer values (a binary law has two).
        strength: a scalar in place of the disorder's; values and weights carry its derivatives.

    Example:
        >>> from torchchain import Disorder
        >>> law = law_of(Disorder(strength=0.1))
        >>> round(law.variance, 6)
        0.01
    """
    checks.instance("disorder", disorder, Disorder)
    nodes = checks.integer("nodes", nodes, 2, _POINTS)
    if strength is not None:
        checks.instance("strength", strength, Tensor)
        if strength.ndim:
            raise checks.fail("strength", "be a scalar", strength)
        disorder = replace(disorder, strength=float(strength.detach()))
    values, weights = _fine_rule(disorder)
    if len(values) > nodes:
        values, weights = _gauss_rule(values, weights, nodes)
    law = Law(torch.from_numpy(values), torch.from_numpy(weights / weights.sum()))
    return law if strength is None or len(values) == 1 else _followed(law, disorder, strength)


def _followed(law: Law, disorder: Disorder, strength: Tensor) -> Law:
    """The same law as a differentiable function of the strength: values that move with it, or weights by their density."""
    xi = disorder.strength
    if disorder.kind in ("uniform", "binary"):
        start, stop = (1 - xi, 1 + xi) if disorder.kind == "binary" else _ends(xi, disorder.lower)
        half = strength * (1.0 if disorder.kind == "binary" else math.sqrt(3))
        lowest = 1 - half if start > disorder.lower or disorder.kind == "binary" else torch.full_like(half, start)
        return Law(lowest + (1 + half - lowest) * ((law.values - start) / (stop - start)), law.weights)

    def height(xi: Tensor) -> Tensor:
        if disorder.kind == "normal":
            return -((law.values - 1) / xi).square() / 2
        if disorder.kind == "lognormal":
            variance = torch.log1p(xi.square())
            return -(law.values.log() + variance / 2).square() / (2 * variance)
        return (law.values.log() - law.values) / xi.square()

    weights = law.weights * torch.exp(height(strength) - height(torch.as_tensor(xi, dtype=law.values.dtype)))
    return Law(law.values, weights / weights.sum())


def _ends(xi: float, lower: float) -> tuple[float, float]:
    """Of the uniform law."""
    return max(lower, 1 - math.sqrt(3) * xi), 1 + math.sqrt(3) * xi


def _fine_rule(disorder: Disorder) -> tuple[np.ndarray, np.ndarray]:
    xi, lower = disorder.strength, disorder.lower
    if xi < 1e-12:  # what is smaller changes no mean in float64
        return np.ones(1), np.ones(1)
    if disorder.kind == "binary":
        return np.array([1 - xi, 1 + xi]), np.array([0.5, 0.5])
    x, w = _legendre()
    if disorder.kind == "uniform":
        return _scaled(x, *_ends(xi, lower)), w
    far = -special.ndtri(_TAIL)
    if disorder.kind == "normal":
        values = _scaled(x, max(lower, 1 - far * xi), 1 + far * xi)
        return values, w * np.exp(-(((values - 1) / xi) ** 2) / 2)
    if disorder.kind == "lognormal":
        sigma = np.sqrt(np.log1p(xi**2))
        start = -far * sigma - sigma**2 / 2
        logs = _scaled(x, max(start, np.log(lower)) if lower > 0 else start, far * sigma - sigma**2 / 2)
        return np.exp(logs), w * np.exp(-(((logs + sigma**2 / 2) / sigma) ** 2) / 2)
    shape = xi**-2
    start = special.gammaincinv(shape, _TAIL) * xi**2
    start = max(start, lower, 1e-300)
    logs = _scaled(x, np.log(start), np.log(special.gammainccinv(shape, _TAIL) * xi**2))
    height = shape * (logs - np.exp(logs))
    return np.exp(logs), w * np.exp(height - height.max())


@functools.cache
def _legendre() -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(_POINTS)


def _scaled(x: np.ndarray, start: float, stop: float) -> np.ndarray:
    return start + (stop - start) * (x + 1) / 2


def _gauss_rule(values: np.ndarray, weights: np.ndarray, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """The Gauss rule of a discrete measure by the Lanczos process with full orthogonalization."""
    basis = np.zeros((nodes, len(values)))
    basis[0] = np.sqrt(weights / weights.sum())
    diagonal, beside = np.zeros(nodes), np.zeros(nodes - 1)
    for i in range(nodes):
        vector = values * basis[i]
        diagonal[i] = basis[i] @ vector
        if i == nodes - 1:
            break
        for _ in range(2):
            vector -= basis[: i + 1].T @ (basis[: i + 1] @ vector)
        beside[i] = np.linalg.norm(vector)
        if beside[i] < 1e-14 * abs(diagonal[0]):
            nodes = i + 1
            break
        basis[i + 1] = vector / beside[i]
    matrix = np.diag(diagonal[:nodes]) + np.diag(beside[: nodes - 1], 1) + np.diag(beside[: nodes - 1], -1)
    found, vectors = np.linalg.eigh(matrix)
    return found, vectors[0] ** 2
