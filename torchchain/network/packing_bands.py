"""Bands of packings: shells of |q| for each polarization on plane waves of the box, and one of all other motion."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy import special
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.chain.disorder import uniform
from torchchain.chain.states import Trajectory
from torchchain.energy.space import positive
from torchchain.network.networks import Network
from torchchain.network.wavenumber import POLARIZATIONS, box_wavevectors, plane_wave_energy, plane_waves, shell_energy

_OTHER = 6  # the random stream of starts in the last band
LARGEST = 2.0  # of the longest wavevector by default, over the mean bond length


@dataclass(frozen=True)
class PackingBands:
    """Equal shells of |q| in (0, largest], for each polarization, and a last band for what is in none of them.

    The last band holds the translation of the whole and all motion that plane waves up to ``largest`` do not make, so
    that the bands add up to the total energy.

    Attributes:
        n_shells: per polarization.
        largest: |q| of the last shell's end.
        polarizations: ("longitudinal", "transverse"), or ("scalar",).

    Example:
        >>> bands = tc.network.PackingBands(2, 1.0, ("longitudinal", "transverse"))
        >>> bands.n_bands, bands.edges.tolist(), bands.labels[-2:]
        (5, [0.0, 0.5, 1.0], ('transverse 2', 'other'))
    """

    n_shells: int
    largest: float
    polarizations: tuple[str, ...]

    @property
    def n_bands(self) -> int:
        return self.n_shells * len(self.polarizations) + 1

    @property
    def edges(self) -> Tensor:
        """|q|, (n_shells + 1,)."""
        return torch.linspace(0, self.largest, self.n_shells + 1, dtype=torch.float64)

    @property
    def labels(self) -> tuple[str, ...]:
        """Of every band: "longitudinal 1", ..., "other"."""
        return (*(f"{name} {shell + 1}" for name in self.polarizations for shell in range(self.n_shells)), "other")


def packing_bands(network: Network, n_shells: int = 4, largest: float | None = None) -> PackingBands:
    """The bands of a network in a periodic box; see :class:`PackingBands`.

    >>> from torchchain.network import lattice
    >>> packing_bands(lattice("square", (12, 12), "scalar"), 2).labels
    ('scalar 1', 'scalar 2', 'other')

    Args:
        network: periodic along every direction.
        n_shells: per polarization.
        largest: |q|; by default 2 over the mean bond length.

    Raises:
        FieldError: for a shell that holds no wavevector of the box, and waves that particles do not tell apart.
    """
    n_shells = checks.integer("n_shells", n_shells, 1, 10**4)
    if largest is None:
        if not network.n_bonds:
            raise checks.fail("bonds", "be at least one for a scale of wavenumbers (or give largest)", 0)
        largest = LARGEST / float(network.lengths.mean())
    largest = checks.number("largest wavenumber", largest, above=0)
    kinds = POLARIZATIONS if network.n_components > 1 else ("scalar",)
    bands = PackingBands(n_shells, largest, kinds)
    lengths = box_wavevectors(network, largest).norm(dim=-1).double().cpu()
    shell = torch.bucketize(lengths[1:] * (1 - 1e-12), bands.edges) - 1
    held = torch.bincount(shell, minlength=n_shells)
    if bool((held == 0).any()):
        raise checks.fail(
            "n_shells",
            "leave a wavevector of the box in every shell",
            f"{n_shells}, with none in shell {int(held.argmin()) + 1}",
        )
    return bands


def packing_band_energy(
    network: Network, trajectory: Trajectory, bands: PackingBands, normalize: bool = True
) -> Tensor:
    """Energy in the bands of a packing, (*batch, time, band); see :func:`torchchain.network.plane_wave_energy`.

    Args:
        network: periodic along every direction.
        trajectory: displacement and velocity (*batch, time, particle, component).
        bands: of :func:`packing_bands`.
        normalize: divide by the total energy.

    Returns:
        (*batch, time, band), in units of energy unless normalized.

    Raises:
        FieldError: for no energy to divide by.

    Example:
        >>> grid = tc.lattice("square", (12, 12), "scalar")
        >>> start = tc.network.plane_wave(grid, (1, 0), "scalar")  # the longest of the box
        >>> still = tc.evolve(grid, start, [0.0], method="modes")
        >>> bands = tc.network.packing_bands(grid, 2)
        >>> tc.network.packing_band_energy(grid, still, bands).squeeze().round(decimals=9).tolist()
        [1.0, 0.0, 0.0]
    """
    waves = plane_wave_energy(network, trajectory, bands.largest)
    shells = shell_energy(waves.lengths, waves.energy, bands.edges).transpose(-2, -1).flatten(-2)
    other = waves.remainder + waves.energy[..., 0, :].sum(-1)
    energy = torch.cat([shells, other[..., None]], dim=-1)
    return energy / positive(energy.sum(-1))[..., None] if checks.truth("normalize", normalize) else energy


def band_starts(network: Network, bands: PackingBands, realization: int = 0, seed: int = 0) -> State:
    """A displacement at rest in each band and in no other, (*batch, band, particle, component).

    In a shell the wave of the wavevector nearest to its middle, the orthonormal one that
    :func:`torchchain.network.plane_wave_energy` measures by; in the last band random displacements less all waves.

    Args:
        network: periodic along every direction.
        bands: of :func:`packing_bands`.
        realization, seed: of the random displacements.

    Example:
        >>> sheet = tc.network.displaced(tc.lattice("triangular", (8, 8)), 0.1)
        >>> bands = tc.network.packing_bands(sheet, 1)
        >>> still = tc.evolve(sheet, tc.network.band_starts(sheet, bands), [0.0], method="chebyshev")
        >>> tc.network.packing_band_energy(sheet, still, bands)[:, 0].round(decimals=9).abs().tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    wavevectors = box_wavevectors(network, bands.largest)
    basis, number, kind = plane_waves(network, wavevectors)
    lengths = wavevectors.norm(dim=-1).cpu()
    starts = []
    for polarization in range(len(bands.polarizations)):
        for low, high in zip(bands.edges[:-1], bands.edges[1:], strict=True):
            off = (lengths - (low + high) / 2).abs()
            chosen = int(torch.where(lengths > 0, off, torch.inf).argmin())
            starts.append(basis[..., int(((number == chosen) & (kind == polarization)).nonzero()[0])])
    n, c = network.n_particles, network.n_components
    noise = torch.from_numpy(special.ndtri(uniform(n * c, realization, seed, _OTHER))).to(basis)
    other = noise - (basis @ (basis.mT @ noise)[..., None])[..., 0]
    starts.append(other / other.norm(dim=-1, keepdim=True))
    field = torch.stack(starts, dim=-2).unflatten(-1, (n, c))
    displacement = field * network.align(network.masses.rsqrt(), field)
    return State(displacement, torch.zeros_like(displacement))
