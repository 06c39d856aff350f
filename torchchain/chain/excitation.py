"""Initial states: impulse (Eq. 22) and standing wave (Section 2.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State

PHASES = ("sin", "cos")


def impulse(chain: Chain, site: int = 1, velocity: float = 0.01) -> State:
    """One particle is given a velocity, all else is at rest (Eq. 22).

    Args:
        chain: masses (*batch, particle).
        site: the particle, counted from 1.
        velocity: in sound speeds of the ordered chain times the initial overlap; small against 1.

    Returns:
        State (*batch, particle).

    Example:
        >>> chain = tc.Chain(torch.ones(4))
        >>> tc.impulse(chain, site=2, velocity=0.01).velocity.tolist()
        [0.0, 0.009999999776482582, 0.0, 0.0]
    """
    checks.instance("chain", chain, Chain)
    site = checks.integer("site", site, 1, chain.n_particles)
    velocity = checks.number("velocity", velocity)
    start = torch.zeros_like(chain.masses)
    start[..., site - 1] = velocity
    return State(torch.zeros_like(start), start)


def standing_wave(chain: Chain, tone: int | Sequence[int] = 1, amplitude: float = 0.01, phase: str = "sin") -> State:
    """A sinusoidal displacement of wavenumber k = 2 pi tone / N at rest (Section 2.6).

    Args:
        chain: masses (*batch, particle); N particles.
        tone: 1 to N/2, or a sequence of them.
        amplitude: in initial overlaps; small against 1.
        phase: "sin" or "cos". The sine of tone N/2 vanishes at every particle and is an error.

    Returns:
        State (*batch, particle), or (*batch, tone, particle) for a sequence.

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64))
        >>> tc.standing_wave(chain, tone=2, amplitude=0.01).displacement.round(decimals=4).tolist()
        [0.01, 0.0, -0.01, 0.0, 0.01, 0.0, -0.01, 0.0]
        >>> tuple(tc.standing_wave(chain, tone=[1, 2, 3]).displacement.shape)
        (3, 8)
    """
    shared = _shared_wave(chain, tone, amplitude, phase)
    return State(shared.displacement.clone(), shared.velocity.clone())


def _shared_wave(chain: Chain, tone: int | Sequence[int], amplitude: float, phase: str) -> State:
    """:func:`standing_wave` with one wave in memory for the whole batch."""
    checks.instance("chain", chain, Chain)
    n = chain.n_particles
    several = checks.is_collection(tone)
    tones: list[Any] = list(tone) if checks.is_collection(tone) else [tone]
    if not tones:
        raise checks.fail("tone", "hold at least one tone", "none")
    amplitude = checks.number("amplitude", amplitude)
    check_tones("tone", tones, n, checks.choice("phase", phase, PHASES))
    # The phase of particle p is (tone p mod N) / N turns: exact integers, whatever the tone.
    particle = torch.arange(1, n + 1)
    turns = (torch.tensor([int(m) for m in tones])[:, None] * particle % n).to(torch.float64) / n
    wave = amplitude * (torch.sin if phase == "sin" else torch.cos)(2 * math.pi * turns)
    if not several:
        wave = wave[0]
    wave = wave.to(chain.masses)
    shape = (*chain.batch_shape, *wave.shape)
    return State(wave.expand(shape), torch.zeros_like(wave).expand(shape))


def check_tones(field: str, tones: Sequence[int], n_particles: int, phase: str) -> None:
    """An error for a tone outside 1..N/2, and for the sine tone N/2, which is zero everywhere."""
    for tone in tones:
        checks.integer(field, tone, 1, n_particles // 2)
        if phase == "sin" and 2 * tone == n_particles:
            raise checks.fail(
                field,
                f"be less than n_particles/2 = {n_particles // 2} for phase 'sin', which vanishes there (use 'cos')",
                tone,
            )


def _size(field: str, value: float) -> float:
    """The value, if the squares of its energies, which the standard errors need, are numbers of float64."""
    value = checks.number(field, value)
    if not 1e-60 <= abs(value) <= 1e60:
        raise checks.fail(field, "have a size between 1e-60 and 1e60", value)
    return value


@dataclass(frozen=True)
class Impulse(checks.Fields):
    """What a scene says of an impulse; see :func:`impulse`.

    Attributes:
        site: the particle, counted from 1.
        velocity: in sound speeds of the ordered chain times the initial overlap.

    Example:
        >>> scene = tc.Scene(n_particles=64, boundary="fixed", excitation=tc.Impulse(site=1), observables=("center",),
        ...                  times=[0.0, 20.0], realizations=4)
        >>> tc.simulate(scene, method="modes").center.dims
        ('time',)
    """

    site: int = 1
    velocity: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "site", checks.integer("excitation.site", self.site, 1))
        object.__setattr__(self, "velocity", _size("excitation.velocity", self.velocity))

    def check(self, n_particles: int) -> None:
        checks.integer("excitation.site", self.site, 1, n_particles)

    def state(self, chain: Chain) -> State:
        return impulse(chain, self.site, self.velocity)


@dataclass(frozen=True)
class StandingWave(checks.Fields):
    """What a scene says of standing waves; see :func:`standing_wave`. Each tone is a wave of its own.

    ``tones=None`` is the center tone of every band, (s - 1/2) N / (2 B) rounded up: 2, 6, ..., 126 for N = 256, B = 32.

    Attributes:
        tones: each 1 to N / 2, counted from 1; None for the center tone of every band.
        amplitude: in initial overlaps.
        phase: "sin" or "cos".

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, excitation=tc.StandingWave(tones=(3, 5)), realizations=4, times=[0.0, 9.0])
        >>> dict(tc.simulate(scene, method="modes").band_energy.sizes)
        {'tone': 2, 'time': 2, 'band': 8}
    """

    tones: tuple[int, ...] | None = None
    amplitude: float = 0.01
    phase: str = "sin"

    def __post_init__(self) -> None:
        if self.tones is not None:
            tones = (self.tones,) if isinstance(self.tones, int) else self.tones
            if isinstance(tones, str) or not isinstance(tones, Sequence) or not tones:
                raise checks.FieldTypeError(
                    f"excitation.tones must be a list of integers, got {checks.shown(self.tones)}"
                )
            tones = tuple(checks.integer("excitation.tones", tone, 1) for tone in tones)
            if len(set(tones)) < len(tones):
                raise checks.fail("excitation.tones", "be different", tones)
            object.__setattr__(self, "tones", tones)
        object.__setattr__(self, "amplitude", _size("excitation.amplitude", self.amplitude))
        checks.choice("excitation.phase", self.phase, PHASES)

    def check(self, n_particles: int) -> None:
        check_tones("excitation.tones", self.tones or (), n_particles, self.phase)

    def state(self, chain: Chain) -> State:
        assert self.tones is not None, "a scene resolves its tones first"
        return _shared_wave(chain, self.tones, self.amplitude, self.phase)
