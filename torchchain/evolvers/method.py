"""What every way to evolve a chain has in common: the record it returns and the facts it states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from torch import Tensor

from torchchain.chain.states import Trajectory

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
