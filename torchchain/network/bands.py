"""Shell bands of lattices: shells of |q| times polarization, their energies, starts and long-time averages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.chain.states import Trajectory
from torchchain.energy.space import positive
from torchchain.modes.motion import modal_amplitudes
from torchchain.network.lattices import Lattice, uniform_stiffness
from torchchain.network.modes import NetworkModes, normal_modes
from torchchain.network.plane_waves import plane_wave
from torchchain.network.trajectories import check_trajectory
from torchchain.network.wavenumber import POLARIZATIONS, zone, zone_of

ZONE_RADIUS = {
    "chain": math.pi,
    "square": math.pi * math.sqrt(2),
    "triangular": 4 * math.pi / 3,
    "cubic": math.pi * math.sqrt(3),
    "fcc": math.pi * math.sqrt(2.5),
}
"""The longest wavevector of the first Brillouin zone of each kind of lattice."""
DEGENERATE = 1e-9  # frequencies nearer than this share of the highest are one


@dataclass(frozen=True)
class ShellBands:
    """Equal shells of |q| in (0, longest of the zone], for each polarization; q = 0 is in none.

    Bands are counted polarization by polarization: longitudinal shells from the longest waves on, then transverse ones.

    Attributes:
        kind: of the lattice.
        n_bands: shells times polarizations.
        polarizations: ("longitudinal", "transverse"), or ("scalar",).

    Example:
        >>> tc.network.shell_bands(tc.lattice("triangular", (8, 8)), 4).labels[:2]
        ('longitudinal 1', 'longitudinal 2')
    """

    kind: str
    n_bands: int
    polarizations: tuple[str, ...]

    @property
    def n_shells(self) -> int:
        """Per polarization."""
        return self.n_bands // len(self.polarizations)

    @property
    def edges(self) -> Tensor:
        """|q|, (n_shells + 1,)."""
        return torch.linspace(0, 1, self.n_shells + 1, dtype=torch.float64) * ZONE_RADIUS[self.kind]

    @property
    def labels(self) -> tuple[str, ...]:
        """Of every band: "longitudinal 1", ..."""
        return tuple(f"{name} {shell + 1}" for name in self.polarizations for shell in range(self.n_shells))


def shell_bands(network: Lattice, n_bands: int) -> ShellBands:
    """The bands of a periodic lattice; see :class:`ShellBands`.

    >>> from torchchain.network import lattice
    >>> shell_bands(lattice("triangular", (8, 8)), 6).labels[2:4]
    ('longitudinal 3', 'transverse 1')

    Raises:
        FieldError: for walls, or bands that two polarizations do not share evenly.
    """
    checks.instance("network", network, Lattice)
    if not network.is_periodic:
        raise checks.fail("boundary", "be periodic for bands of wavevectors", network.boundary)
    return bands_of(network.kind, network.n_components, n_bands)


def bands_of(kind: str, n_components: int, n_bands: int) -> ShellBands:
    """The bands of a kind of lattice with so many displacements per particle."""
    n_bands = checks.integer("n_bands", n_bands, 1, 10**6)
    kinds = POLARIZATIONS if n_components > 1 else ("scalar",)
    if n_bands % len(kinds):
        raise checks.fail("n_bands", "be even: as many longitudinal as transverse shells", n_bands)
    return ShellBands(kind, n_bands, kinds)


def band_energy(network: Lattice, trajectory: Trajectory, n_bands: int = 16, normalize: bool = True) -> Tensor:
    """Energy in shell bands, (*batch, time, band): :func:`torchchain.network.wavenumber_energy` summed over shells.

    Args:
        network: a periodic lattice; masses and bonds may be disordered.
        trajectory: displacement and velocity (*batch, time, particle, component).
        n_bands: shells times polarizations, see :class:`ShellBands`.
        normalize: divide by the total energy, that of q = 0 included.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 9.0], method="modes")
        >>> tuple(tc.network.band_energy(sheet, path, n_bands=8).shape)  # longitudinal and transverse shells
        (2, 8)

    Raises:
        FieldError: also for a state without energy, to be normalized.
    """
    displacement, velocity = check_trajectory(network, trajectory)
    weights = _weights(network, n_bands)
    moving = real_transform(network, velocity)
    energy = _binned(moving, real_transform(network, network.align(network.masses, velocity) * velocity), weights)
    wave = real_transform(network, displacement)
    if network.is_uniform:
        energy = energy + _binned(wave, wave, _weights(network, n_bands, stiff=True))
    else:
        energy = energy + _binned(wave, real_transform(network, -network.force(displacement)), weights)
    return _shares(energy / 2, checks.truth("normalize", normalize), "time")


def real_transform(network: Lattice, field: Tensor) -> Tensor:
    """Unitary real FFT over the lattice, (*any, particle, component) to (*any, component, half of the wavevectors)."""
    d = network.dimension
    grid = field.movedim(-1, -2).unflatten(-1, network.shape)
    return torch.fft.rfftn(grid, dim=tuple(range(-d, 0)), norm="ortho").flatten(-d)


def _binned(first: Tensor, second: Tensor, weights: Tensor) -> Tensor:
    """Re conj(first) . P . second summed over bands, (*any, band), and over everything in a last column.

    Args:
        first, second: transforms, (*any, component, wavevector).
        weights: of each pair of components a <= b, (pair, wavevector, band).
    """
    c, total, pair = first.shape[-2], None, 0
    parts = [(x.real, x.imag) for x in (first, second)]
    for a in range(c):
        for b in range(a, c):
            product = _real(parts[0], a, parts[1], b)
            if a != b:
                product = product + _real(parts[0], b, parts[1], a)
            term = product @ weights[pair]
            total = term if total is None else total + term
            pair += 1
    assert total is not None
    return total


def _real(first: tuple[Tensor, Tensor], a: int, second: tuple[Tensor, Tensor], b: int) -> Tensor:
    """Re conj(first_a) second_b."""
    return first[0][..., a, :] * second[0][..., b, :] + first[1][..., a, :] * second[1][..., b, :]


def _weights(network: Lattice, n_bands: int, stiff: bool = False) -> Tensor:
    """What each wavevector of :func:`real_transform` adds to each band, and to the sum, (pair, wavevector, band + 1).

    Args:
        network: the lattice.
        n_bands: of it.
        stiff: with the stiffness K(q) of a uniform lattice between the two fields.
    """
    bands = shell_bands(network, n_bands)
    force: tuple[float, float] | None = None
    if stiff:
        bond = (torch.as_tensor(x).detach().flatten()[0].item() for x in (network.stiffness, network.tension))
        force = next(bond), next(bond)
    return _made_weights(bands, network.shape, network.motion, force).to(network.masses)


@lru_cache(maxsize=32)
def _made_weights(bands: ShellBands, shape: tuple[int, ...], motion: str, force: tuple[float, float] | None) -> Tensor:
    where = zone_of(bands.kind, shape)
    last = where.turns[:, -1]
    kept = last <= shape[-1] // 2  # of q and -q the transform of real fields holds one
    twice = torch.where((last == 0) | (2 * last == shape[-1]), 1.0, 2.0).double()[kept]
    shell = torch.bucketize(where.lengths[kept] * (1 - 1e-12), bands.edges) - 1
    member = torch.nn.functional.one_hot(shell.clamp(min=0), bands.n_shells).double() * (shell >= 0)[:, None]
    c = len(shape) if motion == "vector" else 1
    one = torch.eye(c, dtype=torch.float64).expand(len(shell), c, c)
    along = where.longitudinal[kept]
    projectors = [along, one - along] if len(bands.polarizations) > 1 else [one]
    if force is not None:
        stiffness = torch.from_numpy(uniform_stiffness(bands.kind, motion, *force, where.wavevectors[kept].numpy()))
        products = [projector @ stiffness for projector in projectors]
        projectors = [(product + product.mT) / 2 for product in products]
    pairs = []
    for a in range(c):
        for b in range(a, c):
            columns = [projector[:, a, b, None] * member for projector in projectors]
            columns.append(torch.stack([projector[:, a, b] for projector in projectors]).sum(0)[:, None])
            pairs.append(torch.cat(columns, dim=-1) * twice[:, None])
    return torch.stack(pairs)


def _shares(energy: Tensor, normalize: bool, axis: str) -> Tensor:
    """The bands, over the sum in the last column where they are to be normalized."""
    bands = energy[..., :-1]
    return bands / positive(energy[..., -1], axis)[..., None] if normalize else bands


@dataclass(frozen=True, eq=False)
class BandWaves:
    """One plane wave for each band.

    Attributes:
        state: (*batch, band, particle, component).
        turns: of each wave, (band, dimension).
        wavenumbers: |q| of each, (band,).

    Example:
        >>> waves = tc.network.band_waves(tc.lattice("triangular", (16, 16)), n_bands=8)
        >>> tuple(waves.state.displacement.shape), tuple(waves.turns.shape)
        ((8, 256, 2), (8, 2))
    """

    state: State
    turns: Tensor
    wavenumbers: Tensor


def band_turns(kind: str, shape: tuple[int, ...], n_shells: int) -> Tensor:
    """Of every shell the wavevector whose length is nearest to its middle, in turns, (shell, dimension).

    Raises:
        FieldError: for a shell that holds no wavevector of its own, naming how many bands have one.
    """
    where, extent = zone_of(kind, shape), torch.tensor(shape)
    usable = ~where.is_edge & ((2 * where.turns % extent) != 0).any(-1)

    def found(n: int) -> list[int]:
        edges = torch.linspace(0, 1, n + 1, dtype=torch.float64) * ZONE_RADIUS[kind]
        shell = torch.bucketize(where.lengths * (1 - 1e-12), edges) - 1
        waves: list[int] = []
        for s in range(n):
            held = (usable & (shell == s)).nonzero()[:, 0]
            if len(held) == 0:
                return waves
            off = (where.lengths[held] - (edges[s] + edges[s + 1]) / 2).abs()
            waves.append(int(held[(off - off.min() < 1e-9).nonzero()[0, 0]]))
        return waves

    waves = found(n_shells)
    if len(waves) < n_shells:
        most = next((n for n in range(min(n_shells, 64), 0, -1) if len(found(n)) == n), 0)
        rule = f"leave a wave inside the zone for every shell of |q| ({most} shells do)"
        raise checks.fail("n_bands", rule, f"{n_shells} shells, with none in shell {len(waves) + 1}")
    return where.turns[waves]


def band_waves(
    network: Lattice, n_bands: int, amplitude: float = 0.01, phase: str = "sin", chosen: Sequence[int] | None = None
) -> BandWaves:
    """For every shell band the plane wave whose |q| is nearest to the middle of the shell, pure in its polarization.

    Args:
        network: a periodic lattice.
        n_bands: shells times polarizations.
        amplitude, phase: see :func:`plane_wave`.
        chosen: the bands whose waves are wanted, counted from 1; None for all.

    Raises:
        FieldError: for a shell that holds no wavevector of its own, naming it.

    Example:
        >>> waves = tc.network.band_waves(tc.lattice("triangular", (16, 16)), n_bands=8)
        >>> waves.wavenumbers.diff()[:3].gt(0).tolist()
        [True, True, True]
    """
    bands = shell_bands(network, n_bands)
    turns = band_turns(network.kind, network.shape, bands.n_shells)
    numbers = range(1, n_bands + 1) if chosen is None else [checks.integer("chosen", r, 1, n_bands) for r in chosen]
    ways = [(turns[(r - 1) % bands.n_shells], bands.polarizations[(r - 1) // bands.n_shells]) for r in numbers]
    waves = [plane_wave(network, way.tolist(), name, amplitude, phase) for way, name in ways]
    displacement = torch.stack([wave.displacement for wave in waves], dim=-3)
    each = torch.stack([way for way, _ in ways])
    lengths = zone(network).lengths
    where = np.ravel_multi_index(tuple(each.T.numpy()), network.shape)
    return BandWaves(State(displacement, torch.zeros_like(displacement)), each, lengths[torch.from_numpy(where)])


def long_time_band_energy(
    network: Lattice, state: State, n_bands: int = 16, normalize: bool = True, modes: NetworkModes | None = None
) -> Tensor:
    """Infinite-time average of :func:`band_energy`, (*batch, *any, band), without stepping in time.

    A mode of energy E_j, half kinetic and half potential on average, has E_j Re conj(s_j^) . P . (M s_j)^ in a band (^:
    transform, P: projector on the polarization), as K s_j = w_j^2 M s_j; a drift at w = 0 keeps its kinetic energy. Modes
    of one frequency, which keep their phases, contribute their cross terms.

    Args:
        network: a periodic lattice, few enough unknowns for all its modes.
        state: the start, (*batch, *any, particle, component).
        n_bands: shells times polarizations.
        normalize: divide by the total energy.
        modes: of the network, where they are at hand.

    Raises:
        FieldError: for a lattice that is not periodic.

    Example:
        >>> sheet = tc.network.disordered(tc.lattice("triangular", (6, 6)), tc.Disorder(strength=0.3), seed=0)
        >>> late = tc.network.long_time_band_energy(sheet, tc.network.plane_wave(sheet, (1, 0)), n_bands=4)
        >>> late.shape[-1]
        4
    """
    weights = _weights(network, n_bands)
    network.check_state(state.displacement)
    modes = normal_modes(network) if modes is None else modes
    coordinate, speed = modal_amplitudes(network, state, modes)
    batch = len(network.batch_shape)
    w = modes.frequencies.reshape(-1, modes.frequencies.shape[-1])
    shapes = modes.shapes.reshape(len(w), *modes.shapes.shape[batch:])
    masses = network.masses.reshape(len(w), -1, 1)
    coordinate, speed = (x.reshape(len(w), -1, x.shape[-1]) for x in (coordinate, speed))
    results = []
    for i in range(len(w)):
        fields = shapes[i].movedim(-1, 0)
        wave, momentum = real_transform(network, fields), real_transform(network, masses[i] * fields)
        swing, motion = coordinate[i] * w[i], speed[i]
        energy = (swing.square() + motion.square()) / 2 @ _binned(wave, momentum, weights)
        # Cross terms of modes of one frequency, those with the next mode, with the next but one, ... while there are any.
        beside = w[i].diff() <= DEGENERATE * w[i, -1]
        equal, d = beside, 1
        while bool(equal.any()):
            low = equal.nonzero()[:, 0]
            cross = swing[:, low] * swing[:, low + d] + motion[:, low] * motion[:, low + d]
            both = _binned(wave[low], momentum[low + d], weights) + _binned(wave[low + d], momentum[low], weights)
            energy = energy + cross @ both / 2
            equal, d = equal[:-1] & beside[d:], d + 1
        results.append(energy)
    found = torch.stack(results).reshape(*state.displacement.shape[:-2], -1)
    return _shares(found, checks.truth("normalize", normalize), "state")
