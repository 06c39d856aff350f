"""Bands of frequency: which modes of a chain lie in each, and the energy of a motion in them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.modes.motion import change_basis
from torchchain.modes.spectrum import NormalModes, normal_modes

MOST_BANDS = 64


@dataclass(frozen=True)
class FrequencyBands:
    """Equal bands of frequency in (0, top]; the last one takes in what lies above, and a rigid motion belongs to none.

    The linear chain keeps the energy of each of its modes, so that what goes from one of these bands to another is the
    work of the contacts' nonlinearity alone; bands of wavenumber exchange energy by the disorder as well.

    Attributes:
        n_bands: B.
        top: upper edge of the last band, in radians per travel time of sound over one particle.

    Example:
        >>> bands = tc.mixing.FrequencyBands(n_bands=4, top=2.0)
        >>> bands.centers.tolist(), bands.of(torch.tensor([0.0, 0.3, 1.9, 2.6])).tolist()
        ([0.25, 0.75, 1.25, 1.75], [-1, 0, 3, 3])
    """

    n_bands: int = 12
    top: float = 2.4

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_bands", checks.integer("n_bands", self.n_bands, 2, MOST_BANDS))
        object.__setattr__(self, "top", checks.number("top", self.top, above=0))

    @classmethod
    def covering(cls, chain: Chain, n_bands: int = 12) -> FrequencyBands:
        """Bands whose top lies above 98 % of the modes of linear chains like these, so that none of them is empty."""
        checks.instance("chain", chain, Chain)
        return cls(n_bands, float(normal_modes(replace(chain, contact="linear")).frequencies.flatten().quantile(0.98)))

    @property
    def width(self) -> float:
        return self.top / self.n_bands

    @property
    def centers(self) -> Tensor:
        """(band,)."""
        return (torch.arange(self.n_bands, dtype=torch.float64) + 0.5) * self.width

    def of(self, frequencies: Tensor) -> Tensor:
        """The band of each frequency, counted from 0; -1 for that of a rigid motion, below a millionth of a band."""
        place = (frequencies / self.width).floor().long().clamp(max=self.n_bands - 1)
        return torch.where(frequencies > 1e-6 * self.width, place, -1)

    def members(self, frequencies: Tensor) -> Tensor:
        """1 where a mode lies in a band, else 0, (*batch, mode, band)."""
        place = self.of(frequencies)
        one_hot = torch.nn.functional.one_hot(place.clamp(min=0), self.n_bands)
        return (one_hot * (place >= 0)[..., None]).to(frequencies)


def frequency_band_energy(
    chain: Chain,
    trajectory: Trajectory,
    bands: FrequencyBands,
    modes: NormalModes | None = None,
    members: Tensor | None = None,
) -> Tensor:
    """Energy of the modes in each band of frequency, sum over j of (p_j^2 + w_j^2 q_j^2) / 2 with q = S^T M u (Eq. 18).

    Of Hertz contacts these are the modes of the linear chain, and the energies leave out the cubic and higher part of the
    potential, some e / 12 of it at the elongation e.

    Args:
        chain: masses (*batch, particle).
        trajectory: displacement and velocity (*batch, *any, time, particle), in initial overlaps.
        bands: of frequency.
        modes: of the linear chain, where they are at hand.
        members: which of them lie in each band, :meth:`FrequencyBands.members`, where that is at hand.

    Returns:
        (*batch, *any, time, band), in units of stiffness times overlap squared.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(32, 2, 0), boundary="fixed")
        >>> path = tc.evolve(chain, tc.impulse(chain, site=5), [0.0, 40.0])
        >>> energy = tc.mixing.frequency_band_energy(chain, path, tc.mixing.FrequencyBands(6))
        >>> torch.allclose(energy[:, 0], energy[:, 1]), torch.allclose(energy.sum(-1), tc.total_energy(chain, path))
        (True, True)
    """
    checks.instance("bands", bands, FrequencyBands)
    modes = normal_modes(replace(chain, contact="linear")) if modes is None else modes
    masses = chain.align(chain.masses, trajectory.displacement)
    position = change_basis(masses * trajectory.displacement, modes.shapes)
    speed = change_basis(masses * trajectory.velocity, modes.shapes)
    frequency = chain.align(modes.frequencies, position)
    members = bands.members(modes.frequencies) if members is None else members
    return change_basis((speed.square() + (frequency * position).square()) / 2, members)
