"""Spectra of networks too large for their modes: density of states and dynamic structure factors, by Chebyshev moments.

With x = 1 - 2 M^-1 K / W^2 and a start f of unit weight, the moments mu_k = <f, T_k(x) f> (in the product of the masses)
are those of f's spectral density over x. Finitely many give it smoothed over pi / n_moments in arccos x by the Jackson
kernel, which keeps it positive (Weisse, Wellein, Alvermann and Fehske, Rev. Mod. Phys. 78, 275, 2006). Each product with
the bonds gives two moments.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.disorder import uniform
from torchchain.network.chebyshev import highest_frequency
from torchchain.network.lattices import Lattice, dynamical_matrix, reciprocal
from torchchain.network.layouts import layout_of
from torchchain.network.modes import check_stability
from torchchain.network.networks import Network
from torchchain.network.plane_waves import plane_wave
from torchchain.network.wavenumber import POLARIZATIONS, polarizations

_STARTS = 5  # the random stream of the starts


@dataclass(frozen=True, eq=False)
class Spectrum:
    """A density over frequency.

    Attributes:
        frequencies: w, (frequency,).
        density: per unit of w, (*any, frequency); its integral over all w is 1.
        stderr: of the density over random starts, or None.

    Example:
        >>> found = tc.network.density_of_states(tc.lattice("square", (16, 16), motion="scalar"), torch.linspace(0.01, 2.9, 300))
        >>> abs(torch.trapezoid(found.density, found.frequencies).item() - 1) < 0.05
        True
    """

    frequencies: Tensor
    density: Tensor
    stderr: Tensor | None = None


def spectral_moments(network: Network, starts: Tensor, n_moments: int) -> tuple[Tensor, float]:
    """Chebyshev moments of some starts, and the W they are scaled by.

    Args:
        network: one network, no batch; stable.
        starts: (start, particle, component); each is divided by its norm in the product of the masses.
        n_moments: how many, even.

    Returns:
        mu_k, (start, moment), and W, at least the highest frequency.

    Example:
        >>> sheet = tc.lattice("square", (8, 8), motion="scalar")
        >>> moments, top = tc.network.spectral_moments(sheet, torch.randn(2, 64, 1, dtype=torch.float64), 16)
        >>> tuple(moments.shape), top >= 8**0.5
        ((2, 16), True)
    """
    if network.batch_shape:
        raise checks.fail(
            "network", "be one network, without batch axes, for spectral moments", tuple(network.batch_shape)
        )
    n_moments = 2 * (checks.integer("n_moments", n_moments, 2, 10**6) // 2)
    network.check_state(starts)
    check_stability(network)
    with torch.no_grad():
        top = float(highest_frequency(network))
        starts = starts.detach()
        masses = network.masses.detach()[:, None]
        norm = (masses * starts.square()).sum((-2, -1)).sqrt()
        checks.first_bad("starts", "not vanish", norm, ~(norm > 0), "start")
        fields = starts / norm[:, None, None]
        if fields.device.type == "cpu":
            moments = torch.stack([_compiled_moments(network, f, n_moments, top) for f in fields])
        else:
            moments = _plain_moments(network, fields, n_moments, top)
    return moments, top


def _doubled(products: Iterator[tuple[Any, Any]]) -> list[Any]:
    """Moments from the products <T_k f, T_k f> and <T_k f, T_k+1 f> for k = 0, 1, ..., by T_j T_k = (T_j+k + T_|j-k|) / 2."""
    zeroth, first = next(products)
    return [zeroth, first] + [part for a, b in products for part in (2 * a - zeroth, 2 * b - first)]


def _plain_moments(network: Network, fields: Tensor, n_moments: int, top: float) -> Tensor:
    masses = network.masses[:, None]
    weight = 4 / top**2 / masses

    def products() -> Iterator[tuple[Tensor, Tensor]]:
        old, new = fields, fields + weight / 2 * network.force(fields)
        for k in range(n_moments // 2):
            if k:
                old, new = new, 2 * new - old + weight * network.force(new)
            yield (masses * old * old).sum((-2, -1)), (masses * old * new).sum((-2, -1))

    return torch.stack(_doubled(products()), dim=-1)


def _compiled_moments(network: Network, field: Tensor, n_moments: int, top: float) -> Tensor:
    layout = layout_of(network)
    run = layout.bind(0, top)
    cells, sums = layout.cells([field.double().numpy()]), layout.sums(0)
    masses = layout.cells([(network.masses.double()[:, None].expand_as(field)).numpy()])[0]
    if cells.ndim == 4:  # rows of a lattice, with copies of their ends
        masses[..., 0] = masses[..., -1] = 0.0
    table = np.zeros((0, n_moments, 2, 1))

    def products() -> Iterator[tuple[float, float]]:
        for k in range(1, n_moments // 2 + 1):
            run((k, k + 1), n_moments, 0, layout.parts, cells, sums, table)
            new, now = cells[k % 2], cells[(k + 1) % 2]
            weighted = masses * now
            yield float(np.vdot(weighted, now)), float(np.vdot(weighted, new))

    return torch.tensor(_doubled(products()), dtype=torch.float64)


def density_from_moments(moments: Tensor, top: float, frequencies: Tensor) -> Tensor:
    """The density over w of given moments with the Jackson kernel, (*any, frequency), zero beyond W.

    Args:
        moments: (*any, moment).
        top: W.
        frequencies: (frequency,).

    Returns:
        (*any, frequency), per unit of w.

    Example:
        >>> sheet = tc.lattice("square", (8, 8), motion="scalar")
        >>> moments, top = tc.network.spectral_moments(sheet, torch.randn(2, 64, 1, dtype=torch.float64), 64)
        >>> tuple(tc.network.density_from_moments(moments, top, torch.linspace(0.1, 2.8, 50)).shape)
        (2, 50)
    """
    n = moments.shape[-1]
    k = torch.arange(n, dtype=torch.float64)
    angle = math.pi / (n + 1)
    jackson = ((n - k + 1) * torch.cos(angle * k) + torch.sin(angle * k) / math.tan(angle)) / (n + 1)
    weights = moments.double().cpu() * jackson * torch.where(k == 0, 1.0, 2.0)
    w = frequencies.double().cpu()
    inside = (w >= 0) & (w <= top)
    # x = 1 - 2 w^2 / W^2 = cos(theta) with w = W sin(theta / 2); d theta = 2 dw / sqrt(W^2 - w^2).
    theta = 2 * torch.asin((w / top).clamp(0, 1))
    series = weights @ torch.cos(k[:, None] * theta) / math.pi
    slope = 2 / (top * (1 - (w / top).square()).clamp(min=1e-12).sqrt())
    return torch.where(inside, series * slope, 0.0).to(moments.device)


def density_of_states(
    network: Network, frequencies: Any, n_moments: int = 512, n_starts: int = 8, seed: int = 0
) -> Spectrum:
    """Density of states g(w), normalized to 1, by random starts.

    Args:
        network: one network, any size.
        frequencies: (frequency,).
        n_moments: the resolution is pi W / n_moments in the middle of the spectrum and finer, to its square, at w = 0.
        n_starts: random vectors whose mean stands for the trace; its error falls as 1 / sqrt(n_starts n_unknowns).
        seed: of the starts.

    Returns:
        Spectrum with density and stderr (frequency,).

    Example:
        >>> found = tc.network.density_of_states(tc.lattice("square", (16, 16), motion="scalar"), [1.0, 5.0])
        >>> found.density[0].item() > 0, found.density[1].item()
        (True, 0.0)
    """
    frequencies = checks.real_tensor("frequencies", frequencies)
    n_starts = checks.integer("n_starts", n_starts, 1)
    n, c = network.n_particles, network.n_components
    signs = np.stack([uniform(n * c, i, seed, _STARTS) < 0.5 for i in range(n_starts)])
    starts = (
        torch.from_numpy(2.0 * signs - 1).reshape(n_starts, n, c).to(network.masses) * network.masses.rsqrt()[:, None]
    )
    moments, top = spectral_moments(network, starts, n_moments)
    density = density_from_moments(moments, top, frequencies)
    stderr = density.std(0) / n_starts**0.5 if n_starts > 1 else None
    return Spectrum(frequencies, density.mean(0), stderr)


def structure_factor(
    network: Network, wavevectors: Any, frequencies: Any, polarization: str = "longitudinal", n_moments: int = 512
) -> Spectrum:
    """Dynamic structure factor of the velocities, S_L(q, w) or S_T(q, w), each normalized to 1 over w.

    The spectral density of the plane wave e exp(i q . x): what a current correlation measures, without time series.

    Args:
        network: one network; a lattice takes whole ``turns`` instead of wavevectors, which fit it exactly.
        wavevectors: (wavevector, dimension); for a :class:`Lattice` integers, the turns of
            :func:`torchchain.network.plane_wave`.
        frequencies: (frequency,).
        polarization: "longitudinal", "transverse" or, for motion "scalar", "scalar".
        n_moments: the resolution is pi W / n_moments.

    Returns:
        Spectrum with density (wavevector, frequency), the mean of both phases of the wave.

    Example:
        >>> sheet, w = tc.lattice("square", (16, 16), motion="scalar"), torch.linspace(0.1, 2.9, 281)
        >>> found = tc.network.structure_factor(sheet, [[4, 0]], w, polarization="scalar")
        >>> round(w[found.density[0].argmax()].item(), 1)  # 2 sin(q / 2) at q = pi / 2
        1.4
    """
    frequencies = checks.real_tensor("frequencies", frequencies)
    waves: list[Tensor] = []
    if isinstance(network, Lattice):
        for turns in torch.as_tensor(wavevectors).tolist():
            # Of a sine that vanishes the cosine is all there is.
            first = "cos" if all(2 * t % n == 0 for t, n in zip(turns, network.shape, strict=False)) else "sin"
            waves += [plane_wave(network, turns, polarization, 1.0, phase).displacement for phase in (first, "cos")]
    else:
        scalar = network.n_components == 1
        checks.choice("polarization", polarization, ("scalar",) if scalar else POLARIZATIONS)
        for q in checks.real_tensor("wavevectors", wavevectors).to(network.positions):
            if not bool(q.any()):
                raise checks.fail("wavevectors", "not be zero", q.tolist())
            frame = polarizations(q, network.dimension)
            direction = torch.ones(1).to(q) if scalar else frame[0 if polarization == "longitudinal" else 1]
            phase = network.positions @ q
            waves += [phase.sin()[:, None] * direction, phase.cos()[:, None] * direction]
    moments, top = spectral_moments(network, torch.stack(waves), n_moments)
    density = density_from_moments(moments, top, frequencies).unflatten(0, (-1, 2)).mean(1)
    return Spectrum(frequencies, density)


def ordered_density(network: Lattice, edges: Any, points: int = 800) -> Tensor:
    """Density of states of a uniform lattice without end, unit masses, normalized to 1, (bin,): the mean over each bin.

    Counts the dispersion relation on a grid of wavevectors.

    Args:
        network: a periodic lattice of equal bonds; its shape does not matter.
        edges: of the bins of w, ascending, (bin + 1,).
        points: of the grid along each direction.

    Example:
        >>> density = tc.network.ordered_density(tc.lattice("square", (8, 8), motion="scalar"), torch.linspace(0, 3, 31), points=200)
        >>> round(density.sum().item() * 0.1, 3)
        1.0
    """
    if not network.is_uniform:
        raise checks.fail(
            "network", "be a periodic lattice of equal bonds for an ordered density of states", network.kind
        )
    edges = checks.real_tensor("edges", edges).double()
    points = checks.integer("points", points, 2)
    # The grid keeps away from the symmetric lines, whose points would count too often.
    turns = [(np.arange(points) + 0.37 + 0.11 * a) / points for a in range(network.dimension)]
    vectors = reciprocal(network.primitive.detach()).double().cpu().numpy()
    counts, total = np.zeros(len(edges) - 1), 0
    for first in turns[0]:
        rest = np.stack(np.meshgrid(*turns[1:], indexing="ij"), axis=-1).reshape(-1, network.dimension - 1)
        q = np.concatenate([np.full((len(rest), 1), first), rest], axis=1) @ vectors
        w = np.sqrt(np.linalg.eigvalsh(dynamical_matrix(network, q)).clip(0))
        counts += np.histogram(w, bins=edges.numpy())[0]
        total += w.size
    return torch.from_numpy(counts / total) / edges.diff()


def born_rate(network: Lattice, frequencies: Any, strength: float, width: float = 0.02, points: int = 800) -> Tensor:
    """Decay rate of the energy of a wave by weak mass disorder, Gamma = (pi / 2) xi^2 w^2 g(w), (frequency,).

    The golden rule (Tamura, Phys. Rev. B 27, 858, 1983, for masses whose variance is xi^2), g being the density of states
    normalized to 1 over all polarizations: in a lattice whose particles see all directions alike each wave scatters into
    each other mode of its frequency with the mean weight 1 / dimension. The amplitude decays at half of it.

    Args:
        network: a uniform lattice.
        frequencies: (frequency,).
        strength: xi, the standard deviation of the masses over their mean.
        width: over which g is averaged.
        points: of the grid behind g; see :func:`ordered_density`.

    Returns:
        (frequency,), per unit time.

    Example:
        >>> rate = tc.network.born_rate(tc.lattice("square", (8, 8), motion="scalar"), [0.5, 1.0], strength=0.1, points=200)
        >>> rate.diff().gt(0).tolist()  # short waves are scattered sooner
        [True]
    """
    frequencies = checks.real_tensor("frequencies", frequencies).double()
    strength = checks.number("strength", strength, at_least=0)
    rates = []
    for w in frequencies.reshape(-1).tolist():
        low = max(w - width / 2, 0.0)
        g = ordered_density(network, [low, low + width], points)[0]
        rates.append(math.pi / 2 * strength**2 * w**2 * g)
    return torch.stack(rates).reshape(frequencies.shape)
