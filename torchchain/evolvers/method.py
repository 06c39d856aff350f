"""What every way to evolve a chain has in common: one record of its facts, and the registry of all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from torchchain import checks
from torchchain.chain.states import State, Trajectory

Advance = Callable[[Tensor], Trajectory]
"""Called with consecutive windows of output times, returns the states at them."""


def targets_of(times: Tensor, now: float) -> list[float]:
    """The times of a window as numbers, none before ``now``, the end of the window before it."""
    targets: list[float] = times.tolist()
    if targets[0] < now:
        raise checks.fail("times", f"continue from {now:g}, the end of the last window", targets[0])
    return targets


@dataclass(frozen=True)
class Method:
    """One way to evolve a chain: what tests, charts, the plan, the memory estimate and the manual read.

    ``start(chain, state, **options)`` checks its arguments and does what is done once; the function it returns
    is called with increasing windows of times.

    Attributes:
        name: for ``evolve(method=)``, an identifier.
        start: see above.
        summary, order, conserves, stability, cost, cannot: in words; an exact method's order starts with "exact".
        boundaries, contacts, damped: the chains it can treat.
        options: name and meaning of each option of ``start``.
        candidate: whether the plan weighs it.
        single_precision: whether it keeps what it computes in float32, where the states are.
        compiled: whether it runs Numba kernels for tensors on the CPU that need no gradient.
        traced: whether ``torch.func`` can trace it, as ``backward()`` can most.
        matrices: how many arrays of n_particles^2 numbers it holds per realization.
        decomposition: seconds per n_particles^2 and per n_particles^3 that a realization takes once, on one core of a 2023
            server, for a method with ``matrices``.
        most_unknowns: degrees of freedom that it can treat at most.
        order_in_step: for a method with a ``step``, the order of its error in it; else None.
        phase_error: c of the error c w^(order + 1) step^order t of a mode of frequency w; nan where it is not known.
        energy_error: c of the largest error c (w step)^order of a mode's energy, which swings; nan where it is not known.
        forces_per_step: evaluations of the contact forces in a step.
        stability_limit: largest stable w_max step; None where no step is limited, or none is stable.

    Example:
        >>> method = tc.METHODS["chebyshev"]
        >>> method.order.split()[0], method.contacts, sorted(method.options)
        ('exact', ('linear',), ['accuracy', 'bound', 'compiled'])
    """

    name: str
    start: Callable[..., Advance]
    summary: str
    order: str = ""
    conserves: str = ""
    stability: str = ""
    cost: str = ""
    cannot: str = ""
    boundaries: tuple[str, ...] = ("periodic", "fixed")
    contacts: tuple[str, ...] = ("linear",)
    damped: bool = False
    options: dict[str, str] = field(default_factory=dict)
    candidate: bool = False
    single_precision: bool = False
    compiled: bool = False
    traced: bool = True
    matrices: int = 0
    decomposition: tuple[float, float] = (6.0e-8, 1.6e-10)
    most_unknowns: float = float("inf")
    order_in_step: int | None = None
    phase_error: float = float("nan")
    energy_error: float = float("nan")
    forces_per_step: int = 1
    stability_limit: float | None = None


METHODS: dict[str, Method] = {}
"""All methods by name."""


def chosen(methods: dict[str, Method], system: Any, state: State, method: str, options: dict[str, Any]) -> Method:
    """The record of a method, if it has these options and treats what damps like the system, a chain or a network."""
    checks.instance("state", state, State)
    entry = methods[checks.choice("method", method, methods)]
    checks.known_keys(f"options of method '{method}'", options, entry.options)
    if system.is_damped and not entry.damped:
        others = ", ".join(name for name, m in methods.items() if m.damped)
        raise checks.fail(
            "damping",
            f"be zero for method '{method}' (methods with damping: {others})",
            f"up to {system.damping.max().item():g}",
        )
    return entry


def register_method(method: Method) -> Method:
    """Add a method of one's own to those that ``evolve``, scenes and the command line know by name.

    Args:
        method: its record. With ``candidate=True`` the plan weighs it, which takes ``order_in_step``, ``phase_error`` and
            ``stability_limit`` for one with a ``step``.

    Returns:
        The method.

    Raises:
        FieldError, FieldTypeError: for a name that is taken or no identifier, or for what is no Method.

    Example:
        >>> def resting(chain, state, **options):  # a method that leaves everything as it was
        ...     def advance(times):
        ...         size = (*state.displacement.shape[:-1], len(times), state.displacement.shape[-1])
        ...         return tc.Trajectory(times, state.displacement.unsqueeze(-2).expand(size), state.velocity.unsqueeze(-2).expand(size))
        ...     return advance
        >>> _ = tc.register_method(tc.Method("resting", resting, "nothing moves"))
        >>> chain = tc.Chain(torch.ones(4))
        >>> tuple(tc.evolve(chain, tc.impulse(chain), [0.0, 1.0], method="resting").velocity.shape)
        (2, 4)
    """
    checks.instance("method", method, Method)
    if not (isinstance(method.name, str) and method.name.isidentifier()):
        raise checks.fail("method.name", "be an identifier", repr(method.name))
    if method.name in METHODS or method.name == "auto":
        raise checks.fail("method.name", "be free", repr(method.name))
    if not callable(method.start):
        raise checks.FieldTypeError(f"method.start must be callable, got {checks.shown(method.start)}")
    METHODS[method.name] = method
    return method
