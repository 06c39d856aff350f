"""What Hertz contacts do to the energy in bands of frequency: ensembles of chains, started in one band, two, or any mixture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.ensemble.scene import Scene
from torchchain.evolvers import evolve
from torchchain.mixing.bands import FrequencyBands, frequency_band_energy
from torchchain.modes.motion import change_basis
from torchchain.modes.spectrum import NormalModes, normal_modes

_PHASES = 2  # a random stream of a realization beside those of masses and stiffnesses
ROWS = 2048
"""Chains that are evolved together."""
SLOW_TIMES = 2.0
"""Default end of a measurement, in units of 1 / amplitude^2: a tenth or so of a band's energy has left it by then."""


@dataclass(frozen=True, eq=False)
class Mixing:
    """Energies of an ensemble of Hertz chains in bands of frequency.

    Attributes:
        scene: the chains.
        bands: of frequency.
        amplitude: root mean square elongation of the start if half of the energy is potential, in initial overlaps; the
            energy per particle is its square.
        starts: share of the energy that each start has in each band, (start, band).
        times: (time,).
        energies: per particle, (realization, start, time, band), in units of stiffness times overlap squared.
        density: modes per particle in each band, (band,), mean over the ensemble.
        opened: contacts that were open at any time, as a share of all, (start,).

    Example:
        >>> scene = tc.Scene(n_particles=32, boundary="fixed", n_bands=4, realizations=4)
        >>> data = tc.mixing.measure_mixing(scene, 0.05, tc.mixing.FrequencyBands(4), times=[0.0, 10.0, 20.0])
        >>> tuple(data.energies.shape)  # 4 single bands and 6 pairs
        (4, 10, 3, 4)
    """

    scene: Scene
    bands: FrequencyBands
    amplitude: float
    starts: Tensor
    times: Tensor
    energies: Tensor
    density: Tensor
    opened: Tensor

    @property
    def mean(self) -> Tensor:
        """(start, time, band)."""
        return self.energies.mean(0)

    @property
    def stderr(self) -> Tensor:
        """Standard error of the mean over realizations, (start, time, band)."""
        return self.energies.std(0) / math.sqrt(len(self.energies))


def measure_mixing(
    scene: Scene,
    amplitude: float,
    bands: FrequencyBands | None = None,
    *,
    starts: Any = None,
    times: Any = None,
    step: float = 0.1,
    progress: Callable[[int], Any] | None = None,
) -> Mixing:
    """Evolve the Hertz chains of a scene by velocity Verlet from modes of random phases, some bands at a time.

    Args:
        scene: chains, boundary, disorder, realizations and seed; its contact, excitation, times and observables do not matter.
        amplitude: root mean square elongation, in initial overlaps; contacts begin to open from about 0.2.
        bands: of frequency; None: 12 that cover the modes of the first 8 chains.
        starts: share of the energy in each band, (start, band), rows of sum 1; None: every band alone, and every two
            bands with half each.
        times: (time,); None: 17 from 0 to 2 / amplitude^2.
        step: of the integrator.
        progress: called with 1 after every start.

    Raises:
        FieldError: for a scene of lattices or of damped chains, or a bad value.

    Example:
        >>> scene = tc.Scene(n_particles=32, boundary="fixed", n_bands=4, realizations=4)
        >>> one = torch.eye(4, dtype=torch.float64)[:1]
        >>> data = tc.mixing.measure_mixing(scene, 0.05, tc.mixing.FrequencyBands(4), starts=one, times=[0.0, 100.0])
        >>> 0 < 1 - float(data.mean[0, 1, 0] / data.mean[0, 0, 0]) < 0.1  # what has left band 1
        True
    """
    checks.instance("scene", scene, Scene)
    if scene.lattice is not None:
        raise checks.fail("lattice", "be None: bands of frequency mix by Hertz contacts of chains", repr(scene.lattice))
    if scene.largest_damping:
        raise checks.fail("damping", "be 0 where mixing is measured", scene.largest_damping)
    amplitude = checks.number("amplitude", amplitude, above=0, at_most=1)
    bands = FrequencyBands.covering(scene.chain(range(min(8, scene.realizations)))) if bands is None else bands
    checks.instance("bands", bands, FrequencyBands)
    shares = _checked_starts(starts, bands)
    slow = torch.linspace(0, SLOW_TIMES / amplitude**2, 17, dtype=torch.float64)
    times = slow if times is None else checks.times("times", times)
    energies = torch.empty(scene.realizations, len(shares), len(times), bands.n_bands, dtype=torch.float64)
    opened, members = torch.zeros(len(shares), dtype=torch.float64), torch.zeros(bands.n_bands, dtype=torch.float64)
    group = max(1, ROWS // scene.n_particles)
    for first in range(0, scene.realizations, group):
        numbers = list(range(first, min(first + group, scene.realizations)))
        linear = replace(scene, contact="linear", tolerance=None).chain(numbers)
        modes = normal_modes(linear)
        hertz = replace(linear, contact="hertz")
        sorted_in = bands.members(modes.frequencies)
        members += sorted_in.sum((0, 1))
        for i, share in enumerate(shares):
            state = random_phases(linear, modes, sorted_in, share * amplitude**2, [(scene.seed, n, i) for n in numbers])
            path = evolve(hertz, state, times, method="verlet", step=step)
            energies[numbers, i] = frequency_band_energy(hertz, path, bands, modes, sorted_in) / scene.n_particles
            assert path.openings is not None, "counted for Hertz contacts"
            opened[i] += path.openings[:, -1].sum() / hertz.n_contacts / scene.realizations
            if progress is not None:
                progress(1)
    density = members / (scene.realizations * scene.n_particles)
    checks.first_bad("bands", "hold modes of the chains each", density, density <= 0, "band")
    return Mixing(scene, bands, amplitude, shares, times, energies, density, opened)


def _checked_starts(starts: Any, bands: FrequencyBands) -> Tensor:
    one = torch.eye(bands.n_bands, dtype=torch.float64)
    if starts is None:
        pairs = [(one[a] + one[b]) / 2 for a in range(bands.n_bands) for b in range(a)]
        return torch.stack([*one, *pairs])
    shares = checks.real_tensor("starts", starts).to(torch.float64)
    if shares.ndim != 2 or shares.shape[1] != bands.n_bands or not len(shares):
        raise checks.fail("starts", f"have shape (start, {bands.n_bands})", shares)
    checks.first_bad("starts", "not be negative", shares, shares < 0, "band")
    off = (shares.sum(1) - 1).abs() > 1e-9
    checks.first_bad("starts", "have rows of sum 1", shares.sum(1), off, "start")
    return shares


def random_phases(
    chain: Chain, modes: NormalModes, members: Tensor, energy: Tensor, keys: list[tuple[int, int, int]]
) -> State:
    """A state whose modes share the energy of their band equally, with phases that are random and independent.

    Args:
        chain: masses (realization, particle).
        modes: of the linear chain.
        members: which modes lie in each band of frequency, :meth:`FrequencyBands.members`.
        energy: per particle in each band, (band,).
        keys: seed, realization and number of the start, which alone decide the phases of each chain.

    Returns:
        State (realization, particle).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(16, 1, 0), boundary="fixed")
        >>> bands, energy = tc.mixing.FrequencyBands(4), torch.tensor([0.0, 0.01, 0.0, 0.0], dtype=torch.float64)
        >>> modes = tc.normal_modes(chain)
        >>> state = tc.mixing.random_phases(chain, modes, bands.members(modes.frequencies), energy, keys=[(0, 0, 0)])
        >>> round(float(chain.energy(state.displacement, state.velocity)), 6)
        0.16
    """
    share = members / members.sum(-2, keepdim=True).clamp(min=1)
    of_mode = chain.n_particles * (share @ energy)
    draws = [
        np.random.Generator(np.random.Philox(key=np.array([seed, number], dtype=np.uint64), counter=[0, start, 0, _PHASES]))
        for seed, number, start in keys
    ]  # fmt: skip
    phase = 2 * math.pi * torch.from_numpy(np.stack([draw.random(chain.n_particles) for draw in draws]))
    root = (2 * of_mode).sqrt()
    frequency = torch.where(of_mode > 0, modes.frequencies, 1.0)
    shapes = modes.shapes.mT
    return State(change_basis(root * phase.cos() / frequency, shapes), change_basis(root * phase.sin(), shapes))
