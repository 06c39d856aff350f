"""What of a start in space decides how its energy will spread: potential and kinetic energy of every tone."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy.bands import bin_energy
from torchchain.energy.space import require_linear, total_energy
from torchchain.energy.wavenumber import product, transform


@dataclass(frozen=True, eq=False)
class StartEnergy:
    """Energies of a start on a ring, tone by tone (tone n: k = 2 pi n / N), k and -k together.

    Attributes:
        potential, kinetic: of tones 1 to N / 2, (*batch, tone).
        virial: momentum times displacement of each tone, (*batch, tone), in energy times time: none where both are a quarter
            of a wave or of a period apart, as in traveling waves and at the turning points of standing ones.
        rigid: kinetic energy at k = 0, which stays there, (*batch,).

    Example:
        >>> chain = tc.Chain(torch.ones(16, dtype=torch.float64))
        >>> start = tc.start_energy(chain, tc.impulse(chain, velocity=1.0))
        >>> start.bands(4).tolist(), start.rigid.item()  # a kick of one bead has as much at every k, at k = pi but half
        ([0.125, 0.125, 0.125, 0.09375], 0.03125)
    """

    potential: Tensor
    kinetic: Tensor
    virial: Tensor
    rigid: Tensor

    def __post_init__(self) -> None:
        for name in ("potential", "kinetic", "virial", "rigid"):
            value = checks.real_tensor(name, getattr(self, name))
            object.__setattr__(self, name, value)
            shape = tuple(self.potential.shape)
            if name == "rigid" and tuple(value.shape) != shape[:-1]:
                raise checks.fail("rigid", f"have shape {shape[:-1]}", value)
            if name != "rigid" and (not shape or tuple(value.shape) != shape):
                raise checks.fail(name, "have the axes (*batch, tone) of potential", value)
            if name in ("potential", "kinetic"):
                checks.first_bad(name, "not be negative", value, value < 0, "tone")

    @property
    def n_particles(self) -> int:
        """N, of the ring."""
        return 2 * self.potential.shape[-1]

    @property
    def total(self) -> Tensor:
        """Energy in all, (*batch,)."""
        return (self.potential + self.kinetic).sum(-1) + self.rigid

    def of_unit_energy(self) -> StartEnergy:
        """The same starts with energy 1 each."""
        size = self.total[..., None]
        return StartEnergy(self.potential / size, self.kinetic / size, self.virial / size, self.rigid / self.total)

    def bands(self, n_bands: int) -> Tensor:
        """Energy in each band, (*batch, band); that at k = 0 is in none."""
        tones = self.potential + self.kinetic
        return bin_energy(torch.cat([self.rigid[..., None], tones], -1), n_bands)


def start_energy(chain: Chain, state: State) -> StartEnergy:
    """The energies of a start by tone, as the average over an ensemble of such chains sees them.

    Which energies a disordered chain has at each wavenumber depends on where its heavy beads are. On average it is as
    the squares of displacement and velocity at that wavenumber have it; their sums are those of the chain itself.

    Args:
        chain: a ring of linear contacts and an even number of particles, masses (*batch, particle).
        state: (*batch, *any, particle).

    Returns:
        StartEnergy with axes (*batch, *any, tone).

    Raises:
        FieldError: for walls, contacts that are not linear, and a start without energy.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0))
        >>> start = tc.start_energy(chain, tc.standing_wave(chain, tone=22))
        >>> start.bands(8)[0].argmax().item() + 1, start.kinetic.sum().item()
        (6, 0.0)
    """
    checks.instance("chain", chain, Chain)
    checks.instance("state", state, State)
    require_linear(chain, "an ensemble of chains")
    n = chain.n_particles
    if not chain.is_free or n % 2:
        raise checks.fail(
            "chain", "be a ring of an even number of particles for energies by tone", f"{chain.boundary}, {n}"
        )
    chain.align(chain.masses, state.displacement)
    here = Trajectory(torch.zeros(1), state.displacement[..., None, :], state.velocity[..., None, :])
    still = Trajectory(here.times, here.displacement, torch.zeros_like(here.velocity))
    whole = total_energy(chain, here)[..., 0]
    checks.first_bad("state", "have energy", whole, ~((whole > 0) & whole.isfinite()), "state")
    bound = total_energy(chain, still)[..., 0].clamp(min=0)
    place, speed = transform(state.displacement), transform(state.velocity)
    k = 2 * math.pi / n * torch.arange(n // 2 + 1, dtype=whole.dtype, device=whole.device)
    fold = torch.ones_like(k)
    fold[0] = fold[-1] = 0.5
    potential = fold * 4 * torch.sin(k / 2).square() * product(place, place)
    kinetic = fold * product(speed, speed)
    virial = fold * product(place, speed)
    stiffness, mass = _ratio(bound, potential.sum(-1)), _ratio(whole - bound, kinetic.sum(-1))
    # What the transforms' rounding leaves at tones without energy is none, nor is a virial of it.
    blurred = 64 * torch.finfo(whole.dtype).eps
    potential, kinetic = (
        size[..., None] * torch.where(x > blurred**2 * x.amax(-1, keepdim=True), x, torch.zeros_like(x))
        for size, x in ((stiffness, potential), (mass, kinetic))
    )  # fmt: skip
    virial = torch.where(virial.abs() > blurred * fold * place.abs() * speed.abs(), virial, torch.zeros_like(virial))
    virial = mass[..., None] * virial * (kinetic > 0)
    return StartEnergy(potential[..., 1:], kinetic[..., 1:], virial[..., 1:], kinetic[..., 0])


def _ratio(part: Tensor, whole: Tensor) -> Tensor:
    return torch.where(whole > 0, part.clamp(min=0) / whole.clamp(min=torch.finfo(whole.dtype).tiny), 0)


def excited(excitation: Any, n_particles: int, dtype: torch.dtype = torch.float64) -> StartEnergy:
    """The energies of an :class:`torchchain.Impulse` or of the waves of a :class:`torchchain.StandingWave`, with an axis of tones.

    Args:
        excitation: its tones given.
        n_particles: N, of the ring.
        dtype: of the energies.

    Raises:
        FieldError: for a site or tone that the ring has not.

    Example:
        >>> start = tc.energy.excited(tc.StandingWave(tones=(3, 5)), 64)
        >>> tuple(start.potential.shape)
        (2, 32)
    """
    checks.integer("n_particles", n_particles, 2)
    excitation.check(n_particles)
    chain = Chain(torch.ones(n_particles, dtype=dtype))
    return start_energy(chain, excitation.state(chain))
