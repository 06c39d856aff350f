"""Solvers of the master equation behind one registry: the matrix exponential and every method of torchdiffeq."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torchdiffeq
from torch import Tensor

from torchchain import checks
from torchchain.master.model import TransferModel, propagate_embedded

ADAPTIVE = ("dopri8", "dopri5", "bosh3", "fehlberg2", "adaptive_heun")
FIXED = ("euler", "midpoint", "heun2", "heun3", "rk4", "explicit_adams", "implicit_adams", "fixed_adams")
ORDERS = {
    "dopri8": 8, "dopri5": 5, "bosh3": 3, "fehlberg2": 2, "adaptive_heun": 2,
    "euler": 1, "midpoint": 2, "heun2": 2, "heun3": 3, "rk4": 4,
}  # fmt: skip
STABILITY = {
    "euler": 2.0, "midpoint": 2.0, "heun2": 2.0, "heun3": 2.5127453266, "rk4": 2.7852935634,
    "explicit_adams": 0.3, "implicit_adams": 1.0, "fixed_adams": 1.0,
}  # fmt: skip
"""Largest |lambda| step that a fixed-step method takes here.

For Runge-Kutta methods the edge on the negative real axis, where sum z^k / k! leaves [-1, 1]; 3/10 for the Adams-Bashforth
method of four steps. The implicit Adams methods are stable to 3, but are solved by fixed-point iteration, which
contracts by 3/8 |lambda| step: 1 keeps it fast.
"""
MOST_STEPS = 10**5
"""Steps from one output time to the next beyond which an adaptive method gives up; a fixed-step method, ten times that in all."""
ADAMS_STEPS = 4
ADAMS_ITERATIONS = 60


class IntegrationError(RuntimeError):
    """A solver could not reach the end of the time span."""


@dataclass(frozen=True)
class Solver:
    """One way to solve the master equation.

    ``run(model, initial, times, supply, **options)`` takes initial (*batch, band), supply (*batch, time, band) or
    None (see ``propagate_embedded``), and returns (*batch, time, band).
    """

    name: str
    run: Callable[..., Tensor]
    summary: str
    options: tuple[str, ...] = ()


def expm(model: TransferModel, initial: Tensor, times: Tensor, supply: Tensor | None = None) -> Tensor:
    """The matrix exponential: exact at every time."""
    if supply is None:
        return model.propagate(initial, times)
    return propagate_embedded(model.embedding(), initial, times, supply)


def largest_over_members(error: Tensor) -> Tensor:
    """Norm for error control: the root mean square of the worst member, not diluted by the rest of the batch."""
    return error.reshape(-1, error.shape[-1]).square().mean(-1).sqrt().max()


def _ode(method: str) -> Callable[..., Tensor]:
    adaptive, scipy = method in ADAPTIVE, method == "scipy_solver"
    fine = ORDERS.get(method, 5) >= 5  # a low order takes minutes to reach what a high one does in milliseconds

    def run(
        model: TransferModel,
        initial: Tensor,
        times: Tensor,
        supply: Tensor | None = None,
        rtol: float | None = None,
        atol: float = 1e-10 if fine else 1e-8,
        step: float | None = None,
        solver: str = "LSODA",
    ) -> Tensor:
        parts = model.embedding()
        start = initial @ parts.start
        # A tolerance below rounding is never met: steps shrink until rounding, which grows with them, is all there is.
        eps = torch.finfo(parts.generator.dtype).eps
        default = max(1e-8 if fine else 1e-6, 16 * eps)
        rtol = default if rtol is None else checks.number("rtol", rtol, at_least=4 * eps, below=1)
        atol = checks.number("atol", atol, above=0)
        span = times if float(times[0]) == 0.0 else torch.cat([times.new_zeros(1), times])
        options: dict[str, Any]
        if scipy:
            options = {"solver": checks.choice("solver", solver, ("RK45", "RK23", "DOP853", "Radau", "BDF", "LSODA"))}
        elif adaptive:  # steps end at the output times: between them the solution is known to a lower order only
            options = {"norm": largest_over_members, "max_num_steps": MOST_STEPS}
        else:
            # Between steps by cubics: torchdiffeq's straight lines would make every method one of second order.
            options = {"step_size": _checked_step(method, parts.generator, step, float(times[-1])), "interp": "cubic"}
            if method.endswith("adams"):
                options |= {"max_order": ADAMS_STEPS, "max_iters": ADAMS_ITERATIONS}

        def integrate(y: Tensor, span: Tensor, inflow: Tensor | float) -> Tensor:
            def slope(t: Tensor, y: Tensor) -> Tensor:
                return y @ parts.generator + inflow

            stops = {"step_t": span} if adaptive else {}
            return torchdiffeq.odeint(slope, y, span, rtol=rtol, atol=atol, method=method, options=options | stops)

        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("error", message=".*[Ff]unctional iteration did not converge.*")
                if len(span) == 1:  # only time 0 is asked for
                    path = start[None]
                elif supply is None:
                    path = integrate(start, span, 0.0)
                else:  # the supply jumps at the output times
                    fed = supply[..., -(len(span) - 1) :, :] @ parts.start
                    states = [start.expand(torch.broadcast_shapes(start.shape, fed[..., 0, :].shape))]
                    for i in range(len(span) - 1):
                        states.append(integrate(states[-1], span[i : i + 2], fed[..., i, :])[-1])
                    path = torch.stack(states)
        except (AssertionError, UserWarning) as error:
            raise IntegrationError(
                f"solver '{method}' must reach time {float(times[-1]):g} with rtol {rtol:g} and atol {atol:g} "
                f"in {start.dtype}, got: {error}"
            ) from None
        return torch.movedim(path[-len(times) :] @ parts.readout, 0, -2)

    return run


def _checked_step(method: str, generator: Tensor, step: float | None, end: float) -> float:
    """The step to use, given or half the stability limit: stable, and not too many of them."""
    fastest = float(torch.linalg.eigvals(generator.detach()).abs().max())
    reach = STABILITY[method]
    limit = reach / fastest if fastest > 0 else float("inf")
    step = min(limit / 2, 1.0) if step is None else checks.number("step", step, above=0)
    if end / step > 10 * MOST_STEPS:
        raise checks.fail(
            "times", f"take at most {10 * MOST_STEPS} steps of {step:.3g} with '{method}' (expm has no steps)", end
        )
    if step > limit * (1 + 1e-9):
        raise checks.fail(
            "step",
            f"be at most {limit:.6g} for '{method}' (|lambda| step <= {reach:.4g}, fastest rate {fastest:.4g})",
            step,
        )
    return step


SOLVERS: dict[str, Solver] = {
    "expm": Solver("expm", expm, "matrix exponential, exact"),
    **{name: Solver(name, _ode(name), "torchdiffeq, adaptive step", ("rtol", "atol")) for name in ADAPTIVE},
    **{
        name: Solver(
            name, _ode(name), "torchdiffeq, fixed step", ("step", "rtol", "atol") if "adams" in name else ("step",)
        )
        for name in FIXED
    },
    "scipy_solver": Solver(
        "scipy_solver", _ode("scipy_solver"), "torchdiffeq, SciPy's solvers", ("rtol", "atol", "solver")
    ),
}
