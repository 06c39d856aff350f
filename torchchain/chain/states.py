"""States of chains: displacement and velocity at one instant, and at many (a trajectory)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from torchchain import checks


@dataclass(frozen=True, eq=False)
class State:
    """Displacement and velocity of every particle at one instant, each (*batch, *any, particle).

    Attributes:
        displacement: in initial overlaps.
        velocity: in initial overlaps per travel time of sound over one particle.

    Example:
        >>> state = tc.State(displacement=torch.zeros(5), velocity=torch.ones(5))
        >>> tuple(state.velocity.shape)
        (5,)
    """

    displacement: Tensor
    velocity: Tensor

    def __post_init__(self) -> None:
        for field in ("displacement", "velocity"):
            object.__setattr__(self, field, checks.real_tensor(field, getattr(self, field)))
        if self.displacement.shape != self.velocity.shape:
            rule = f"have the displacement's shape {tuple(self.displacement.shape)}"
            raise checks.fail("velocity", rule, self.velocity)
        if self.displacement.ndim == 0:
            raise checks.fail("displacement", "have particles on its last axis", "shape ()")

    def __add__(self, other: State) -> State:
        """The superposition of two states."""
        return State(self.displacement + other.displacement, self.velocity + other.velocity)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States of chains in time.

    Attributes:
        times: (time,).
        displacement, velocity: (*batch, *any, time, particle).
        dissipated: energy lost to contact damping since time 0, (*batch, *any, time); None if undamped.
        openings: contacts open at any step up to each time, (*batch, *any, time); None for linear contacts.

    Example:
        >>> chain = tc.Chain(torch.ones(16))
        >>> path = tc.evolve(chain, tc.impulse(chain, site=3), [0.0, 1.0, 2.0], method="modes")
        >>> tuple(path.displacement.shape), path.dissipated is None
        ((3, 16), True)
    """

    times: Tensor
    displacement: Tensor
    velocity: Tensor
    dissipated: Tensor | None = None
    openings: Tensor | None = None
    axes_of_a_state: ClassVar[tuple[str, ...]] = ("particle",)

    def __post_init__(self) -> None:
        checks.instance("trajectory.times", self.times, Tensor)
        if self.times.ndim != 1:
            raise checks.fail("trajectory.times", "be one-dimensional", self.times)
        for field in ("displacement", "velocity"):
            value = getattr(self, field)
            checks.instance(f"trajectory.{field}", value, Tensor)
            if value.dtype not in (torch.float32, torch.float64) or value.layout != torch.strided or value.is_meta:
                raise checks.FieldTypeError(
                    f"trajectory.{field} must be a dense tensor of float32 or float64, got {value.dtype} on {value.device}"
                )
        shape, inner = self.displacement.shape, len(self.axes_of_a_state)
        if len(shape) < 1 + inner or shape[-1 - inner] != len(self.times):
            rule = f"have shape (*batch, time, {', '.join(self.axes_of_a_state)}) with {len(self.times)} times"
            raise checks.fail("trajectory.displacement", rule, f"shape {tuple(shape)}")
        for field, expected in (("velocity", shape), ("dissipated", shape[:-inner]), ("openings", shape[:-inner])):
            value = getattr(self, field)
            if value is not None and value.shape != expected:
                rule = f"have shape {tuple(expected)} beside the displacement"
                raise checks.fail(f"trajectory.{field}", rule, value)

    @property
    def final(self) -> State:
        """The state at the last time."""
        time = -1 - len(self.axes_of_a_state)
        return State(self.displacement.select(time, -1), self.velocity.select(time, -1))
