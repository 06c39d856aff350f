"""torchdiffeq's integrators: what is known of each, and how a batch is integrated by one without mixing its members."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


class IntegrationError(RuntimeError):
    """A solver could not reach the end of the time span.

    Example:
        >>> growing = tc.RateModel(torch.diag(torch.tensor([10.0, 10.0], dtype=torch.float64)), torch.zeros(2, dtype=torch.float64))
        >>> try:
        ...     _ = tc.MasterEquation(growing, None).solve(torch.ones(2, dtype=torch.float64), [0.0, 500.0])
        ... except tc.IntegrationError as error:
        ...     print(error)
        solver 'expm' must stay finite, got overflow up to time 500
    """


@dataclass(frozen=True)
class Integrator:
    """One method of torchdiffeq.

    Attributes:
        name: torchdiffeq's.
        summary: the method's own name.
        order: of its error in the step; None where it varies.
        evaluations: of the right-hand side per step; None where they vary.
        adaptive: whether it chooses its steps.
        decay_limit: largest stable step times |lambda| on the negative real axis; None for adaptive ones.
        swing_limit: largest stable step times w on the imaginary axis; 0 where no step is stable, None for adaptive ones.
    """

    name: str
    summary: str
    order: int | None
    evaluations: int | None
    adaptive: bool = False
    decay_limit: float | None = None
    swing_limit: float | None = None


# The limits of Runge-Kutta methods are where |sum z^k / k!| leaves 1: on the real axis of order 3 at 2.5127 and 4 at 2.7853,
# on the imaginary axis at sqrt(3) and sqrt(8). Of the Adams-Bashforth method of four steps they are 3/10 and 0.43.
INTEGRATORS: dict[str, Integrator] = {
    entry.name: entry
    for entry in (
        Integrator("dopri8", "Dormand and Prince 8(7)", 8, 13, adaptive=True),
        Integrator("dopri5", "Dormand and Prince 5(4)", 5, 6, adaptive=True),
        Integrator("bosh3", "Bogacki and Shampine 3(2)", 3, 3, adaptive=True),
        Integrator("fehlberg2", "Fehlberg 2(1)", 2, 3, adaptive=True),
        Integrator("adaptive_heun", "Heun 2(1)", 2, 2, adaptive=True),
        Integrator("scipy_solver", "SciPy's solvers", None, None, adaptive=True),
        Integrator("euler", "explicit Euler rule", 1, 1, decay_limit=2.0, swing_limit=0.0),
        Integrator("midpoint", "explicit midpoint rule", 2, 2, decay_limit=2.0, swing_limit=0.0),
        Integrator("heun2", "Heun's second-order rule", 2, 2, decay_limit=2.0, swing_limit=0.0),
        Integrator("heun3", "Heun's third-order rule", 3, 3, decay_limit=2.5127453266, swing_limit=3**0.5),
        Integrator("rk4", "Runge-Kutta, 3/8 rule", 4, 4, decay_limit=2.7852935634, swing_limit=8**0.5),
        Integrator(
            "explicit_adams", "Adams and Bashforth with four past steps", 4, 1, decay_limit=0.3, swing_limit=0.43
        ),
        # Limits of the implicit formulas solved to convergence by fixed points, which contract by 3/8 |lambda| step.
        Integrator("implicit_adams", "Adams and Moulton", None, None, decay_limit=8 / 3, swing_limit=0.0),
        Integrator("fixed_adams", "Adams and Moulton", None, None, decay_limit=8 / 3, swing_limit=0.0),
    )
}


def member_norm(error: Tensor) -> Tensor:
    """Norm for error control: root mean square of the worst member, where torchdiffeq would average over the batch."""
    return error.square().mean(-1).sqrt().amax()


def step_grid(outputs: Sequence[float], counts: Sequence[int]) -> Tensor:
    """Steps that end at every output: counts[i] equal ones from outputs[i] to outputs[i + 1]; for ``grid_constructor``."""
    pieces = [
        torch.linspace(begin, end, count + 1, dtype=torch.float64)[:-1]
        for begin, end, count in zip(outputs[:-1], outputs[1:], counts, strict=True)
    ]
    return torch.cat([*pieces, torch.tensor(outputs[-1:], dtype=torch.float64)])
