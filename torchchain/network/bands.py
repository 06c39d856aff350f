"""Shell bands of lattices: shells of |q| times polarization, their energies, starts and long-time averages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import State
from torchchain.chain.excitation import PHASES
from torchchain.chain.states import Trajectory
from torchchain.network.lattices import Lattice
from torchchain.network.modal import amplitudes
from torchchain.network.modes import NetworkModes, normal_modes
from torchchain.network.wavenumber import POLARIZATIONS, Zone, _split, shell_energy, wavenumber_energy, zone

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
        n_shells: per polarization.
        polarizations: ("longitudinal", "transverse"), or ("scalar",).

    Example:
        >>> tc.network.shell_bands(tc.lattice("triangular", (8, 8)), 4).labels[:2]
        ('longitudinal 1', 'longitudinal 2')
    """

    kind: str
    n_shells: int
    polarizations: tuple[str, ...]

    @property
    def n_bands(self) -> int:
        return self.n_shells * len(self.polarizations)

    @property
    def edges(self) -> Tensor:
        """|q|, (n_shells + 1,)."""
        return torch.linspace(0, 1, self.n_shells + 1, dtype=torch.float64) * ZONE_RADIUS[self.kind]

    @property
    def labels(self) -> tuple[str, ...]:
        """Of every band: "longitudinal 1", ..."""
        return tuple(f"{name} {shell + 1}" for name in self.polarizations for shell in range(self.n_shells))


def shell_bands(network: Lattice, n_shells: int) -> ShellBands:
    """The bands of a periodic lattice; see :class:`ShellBands`.

    >>> from torchchain.network import lattice
    >>> shell_bands(lattice("triangular", (8, 8)), 3).labels[2:4]
    ('longitudinal 3', 'transverse 1')
    """
    checks.instance("network", network, Lattice)
    n_shells = checks.integer("n_shells", n_shells, 1, 10**6)
    if not network.is_periodic:
        raise checks.fail("boundary", "be periodic for bands of wavevectors", network.boundary)
    kinds = POLARIZATIONS if network.n_components > 1 else ("scalar",)
    return ShellBands(network.kind, n_shells, kinds)


def band_energy(network: Lattice, trajectory: Trajectory, n_shells: int = 8, normalize: bool = True) -> Tensor:
    """Energy in shell bands, (*batch, time, band).

    Args:
        network: a periodic lattice.
        trajectory: displacement and velocity (*batch, time, particle, component).
        n_shells: per polarization.
        normalize: divide by the total energy, that of q = 0 included.

    Example:
        >>> sheet = tc.lattice("triangular", (8, 8))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (2, 0)), [0.0, 9.0], method="modes")
        >>> tuple(tc.network.band_energy(sheet, path, n_shells=4).shape)  # longitudinal and transverse shells
        (2, 8)
    """
    bands = shell_bands(network, n_shells)
    energy = wavenumber_energy(network, trajectory)
    binned = _binned(bands, zone(network), energy)
    return _normalized(binned, energy.sum((-2, -1))) if checks.truth("normalize", normalize) else binned


def _binned(bands: ShellBands, where: Zone, energy: Tensor) -> Tensor:
    return shell_energy(where.lengths, energy, bands.edges).transpose(-2, -1).flatten(-2)


def _normalized(bands: Tensor, total: Tensor) -> Tensor:
    bad = ~((total > 0) & total.isfinite())
    checks.first_bad("total energy", "be positive and finite to normalize", total, bad, "time")
    return bands / total[..., None]


def plane_wave(
    network: Lattice,
    turns: Sequence[int],
    polarization: str = "longitudinal",
    amplitude: float = 0.01,
    phase: str = "sin",
) -> State:
    """A displacement e A sin(q . x) at rest, (*batch, particle, component).

    Args:
        network: a periodic lattice.
        turns: how many wavelengths fit along each primitive direction: q = sum of turns / shape times reciprocal vectors.
        polarization: "longitudinal" (e along q, folded into the first zone), "transverse" (across; the first of two in
            three dimensions) or "scalar" for one component.
        amplitude: A.
        phase: "sin" or "cos".

    Raises:
        FieldError: for a sine that vanishes on every particle, and for a direction that q = 0 does not have.

    Example:
        >>> wave = tc.network.plane_wave(tc.lattice("triangular", (8, 8)), turns=(1, 0), polarization="transverse")
        >>> tuple(wave.displacement.shape)
        (64, 2)
    """
    where = zone(network)
    numbers = [checks.integer("turns", t) for t in turns]
    if len(numbers) != network.dimension:
        raise checks.fail("turns", f"have {network.dimension} entries", numbers)
    allowed = POLARIZATIONS if network.n_components > 1 else ("scalar",)
    checks.choice("polarization", polarization, allowed)
    checks.choice("phase", phase, PHASES)
    amplitude = checks.number("amplitude", amplitude)
    shape = torch.tensor(network.shape)
    wrapped = torch.tensor(numbers) % shape
    if phase == "sin" and bool(((2 * wrapped) % shape == 0).all()):
        raise checks.fail("turns", "not be those of a sine that vanishes at every particle (use phase 'cos')", numbers)
    which = int((where.turns.cpu() == wrapped).all(-1).nonzero()[0])
    # Whole turns are left out exactly: the phase is a ratio of integers.
    sites = where.turns.cpu()  # row-major coordinates of the particles, too
    common = math.lcm(*network.shape)
    cycle = ((sites * wrapped * (common // shape)).sum(-1) % common).to(torch.float64)
    angle = (2 * math.pi * cycle / common).to(network.positions)
    wave = amplitude * (angle.sin() if phase == "sin" else angle.cos())
    direction = _direction(where.wavevectors[which], network.n_components, polarization, numbers)
    field = (wave[:, None] * direction).expand(*network.batch_shape, -1, -1).clone()
    return State(field, torch.zeros_like(field))


def _direction(q: Tensor, components: int, polarization: str, turns: list[int]) -> Tensor:
    if components == 1:
        return torch.ones(1).to(q)
    if not bool(q.any()):
        raise checks.fail("turns", "not all be zero for a polarization", turns)
    unit = q / q.norm()
    if polarization == "longitudinal":
        return unit
    if components == 2:
        return torch.stack([-unit[1], unit[0]])
    axis = torch.zeros_like(unit)
    axis[int(unit.abs().argmin())] = 1.0
    across = axis - (axis @ unit) * unit
    return across / across.norm()


@dataclass(frozen=True, eq=False)
class BandWaves:
    """One plane wave for each band.

    Attributes:
        state: (*batch, band, particle, component).
        turns: of each wave, (band, dimension).
        wavenumbers: |q| of each, (band,).

    Example:
        >>> waves = tc.network.band_waves(tc.lattice("triangular", (16, 16)), n_shells=4)
        >>> tuple(waves.state.displacement.shape), tuple(waves.turns.shape)
        ((8, 256, 2), (8, 2))
    """

    state: State
    turns: Tensor
    wavenumbers: Tensor


def band_waves(network: Lattice, n_shells: int, amplitude: float = 0.01, phase: str = "sin") -> BandWaves:
    """For every shell band the plane wave whose |q| is nearest to the middle of the shell, pure in its polarization.

    Raises:
        FieldError: for a shell that holds no wavevector of its own, naming it.

    Args:
        network: a periodic lattice.
        n_shells: per polarization.
        amplitude: of the displacement.
        phase: "sin" or "cos".

    Example:
        >>> waves = tc.network.band_waves(tc.lattice("triangular", (16, 16)), n_shells=4)
        >>> waves.wavenumbers.diff()[:3].gt(0).tolist()
        [True, True, True]
    """
    bands, where = shell_bands(network, n_shells), zone(network)
    edges = bands.edges.to(where.lengths)
    shape = torch.tensor(network.shape, device=where.turns.device)
    usable = ~where.is_edge & ((2 * where.turns % shape) != 0).any(-1)
    shell = torch.bucketize(where.lengths * (1 - 1e-12), edges) - 1
    displacements, velocities, turns, lengths = [], [], [], []
    for name in bands.polarizations:
        for s in range(n_shells):
            held = (usable & (shell == s)).nonzero()[:, 0]
            if len(held) == 0:
                raise checks.fail(
                    "n_shells",
                    "leave a wave inside the zone for every shell",
                    f"{n_shells}, with none in shell {s + 1}",
                )
            off = (where.lengths[held] - (edges[s] + edges[s + 1]) / 2).abs()
            best = int(held[(off - off.min() < 1e-9).nonzero()[0, 0]])
            wave = plane_wave(network, where.turns[best].tolist(), name, amplitude, phase)
            displacements.append(wave.displacement)
            velocities.append(wave.velocity)
            turns.append(where.turns[best])
            lengths.append(where.lengths[best])
    state = State(torch.stack(displacements, dim=-3), torch.stack(velocities, dim=-3))
    return BandWaves(state, torch.stack(turns), torch.stack(lengths))


def long_time_band_energy(
    network: Lattice, state: State, n_shells: int = 8, normalize: bool = True, modes: NetworkModes | None = None
) -> Tensor:
    """Infinite-time average of :func:`band_energy`, (*batch, *any, band), without stepping in time.

    A state is a sum of motions A cos(w t) + B sin(w t), one for every different frequency w (modes of one frequency are
    summed first, as they keep their phases); products of different ones average to zero, so that the average is the sum
    over w of w^2 [k(A) + k(B)], with k the kinetic energy of :func:`torchchain.network.wavenumber_energy` at velocity A.
    A drift at w = 0 keeps its kinetic energy.

    Args:
        network: a periodic lattice, few enough unknowns for all its modes.
        state: the start, (*batch, *any, particle, component).
        n_shells: per polarization.
        normalize: divide by the total energy.
        modes: of the network, where they are at hand.

    Raises:
        FieldError: for a lattice that is not periodic.

    Example:
        >>> sheet = tc.network.disordered(tc.lattice("triangular", (6, 6)), tc.Disorder(strength=0.3), seed=0)
        >>> late = tc.network.long_time_band_energy(sheet, tc.network.plane_wave(sheet, (1, 0)), n_shells=2)
        >>> late.shape[-1]
        4
    """
    bands, where = shell_bands(network, n_shells), zone(network)
    network.check_state(state.displacement)
    modes = normal_modes(network) if modes is None else modes
    coordinate, speed = amplitudes(network, state, modes)
    batch = len(network.batch_shape)
    w = modes.frequencies.reshape(-1, modes.frequencies.shape[-1])
    shapes = modes.shapes.reshape(len(w), *modes.shapes.shape[batch:])
    masses = network.masses.reshape(len(w), -1, 1)
    coordinate, speed = (x.reshape(len(w), -1, x.shape[-1]) for x in (coordinate, speed))
    results = []
    for i in range(len(w)):
        new = torch.cat(
            [torch.zeros(1, dtype=torch.int64, device=w.device), (w[i].diff() > DEGENERATE * w[i, -1]).long()]
        )
        cluster = new.cumsum(0)
        n_clusters = int(cluster[-1]) + 1
        for a, b in zip(coordinate[i], speed[i], strict=True):
            # Half of a cluster's energy is kinetic at every phase's mean; a drift's is all of it, and steady: k either way.
            total = torch.zeros(()).to(w)
            for weight in (a * w[i], b):
                parts = shapes[i].movedim(-1, 0) * weight[:, None, None]
                velocity = torch.zeros(n_clusters, *parts.shape[1:], dtype=parts.dtype, device=parts.device)
                velocity = velocity.index_add(0, cluster, parts)
                total = total + _split(network, where, velocity, masses[i] * velocity)
            results.append(total.sum(0))
    energy = torch.stack(results).reshape(*state.displacement.shape[:-2], *results[0].shape)
    binned = _binned(bands, where, energy)
    return _normalized(binned, energy.sum((-2, -1))) if checks.truth("normalize", normalize) else binned
