"""What every way to evolve a chain has in common: the record it returns and the facts it states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchchain.excitation import State


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States of chains in time.

    Attributes:
        times: (time,).
        displacement, velocity: (*batch, *any, time, particle).
        dissipated: energy lost to contact damping since time 0, (*batch, *any, time); None if undamped.
        openings: contacts open at any step up to each time, (*batch, *any, time); None for linear contacts.
    """

    times: Tensor
    displacement: Tensor
    velocity: Tensor
    dissipated: Tensor | None = None
    openings: Tensor | None = None

    @property
    def final(self) -> State:
        """The state at the last time."""
        return State(self.displacement[..., -1, :], self.velocity[..., -1, :])


Advance = Callable[[Tensor], Trajectory]
"""Called with consecutive windows of output times, returns the states at them."""


@dataclass(frozen=True)
class Method:
    """One way to evolve a chain: the registry's entry, which tests, charts, the plan and the manual iterate over.

    ``start(chain, state, **options)`` checks its arguments and does what is done once; the function it returns
    is called with increasing windows of times.
    """

    name: str
    start: Callable[..., Advance]
    summary: str
    order: str
    conserves: str
    stability: str
    cost: str
    cannot: str
    boundaries: tuple[str, ...] = ("periodic", "fixed")
    contacts: tuple[str, ...] = ("linear",)
    damped: bool = False
    options: dict[str, str] = field(default_factory=dict)


def join(parts: list[Trajectory]) -> Trajectory:
    """One trajectory from consecutive windows."""
    if len(parts) == 1:
        return parts[0]

    def series(name: str, axis: int) -> Tensor | None:
        pieces = [getattr(part, name) for part in parts]
        return None if pieces[0] is None else torch.cat(pieces, dim=axis)

    return Trajectory(
        torch.cat([part.times for part in parts]),
        torch.cat([part.displacement for part in parts], dim=-2),
        torch.cat([part.velocity for part in parts], dim=-2),
        series("dissipated", -1),
        series("openings", -1),
    )
