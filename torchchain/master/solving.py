"""Solvers of the master equation behind one registry: the matrix exponential and every method of torchdiffeq."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchchain import checks
from torchchain.master.model import TransferModel, propagate_embedded
from torchchain.odes import INTEGRATORS, IntegrationError, Integrator, member_norm

MOST_STEPS = 10**5
"""Steps from one output time to the next beyond which an adaptive method gives up; a fixed-step method, ten times that in all."""
GROWTH = 0.01
"""Largest exponent by which the steps chosen here make a mode grow that does not: the Euler rule makes every oscillation grow."""
ADAMS_STEPS = 4
ADAMS_ITERATIONS = 60


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


def stability_limit(integrator: Integrator) -> float:
    """Largest |lambda| step that is taken here: the edge of stability on the negative real axis, and for the implicit
    Adams methods, whose fixed-point iteration contracts by 3/8 |lambda| step, 1 to keep it fast."""  # fmt: skip
    assert integrator.decay_limit is not None, "adaptive methods choose their steps"
    return 1.0 if integrator.order is None else integrator.decay_limit


def _ode(integrator: Integrator) -> Callable[..., Tensor]:
    method, scipy = integrator.name, integrator.name == "scipy_solver"
    adaptive = integrator.adaptive and not scipy
    fine = (integrator.order or 5) >= 5  # a low order takes minutes to reach what a high one does in milliseconds

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
        import torchdiffeq  # takes a second or two, which most users never need

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
            options = {"norm": member_norm, "max_num_steps": MOST_STEPS}
        else:
            # Between steps by cubics: torchdiffeq's straight lines would make every method one of second order.
            options = {
                "step_size": _checked_step(integrator, parts.generator, step, float(times[-1])),
                "interp": "cubic",
            }
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
                    states = [start.expand(np.broadcast_shapes(start.shape, fed[..., 0, :].shape))]
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


def _checked_step(integrator: Integrator, generator: Tensor, step: float | None, end: float) -> float:
    """The step to use, given or half the stability limit: stable, and not too many of them."""
    eigenvalues = torch.linalg.eigvals(generator.detach()).cpu().numpy()
    fastest = float(np.abs(eigenvalues).max())
    edge, method = stability_limit(integrator), integrator.name
    limit = edge / fastest if fastest > 0 else float("inf")
    given = None if step is None else checks.number("step", step, above=0)
    step = min(limit / 2, 1.0) if given is None else given
    while given is None and growth(integrator, eigenvalues, step, end) > GROWTH and end / step <= 10 * MOST_STEPS:
        step /= 2
    if end / step > 10 * MOST_STEPS:
        raise checks.fail(
            "times", f"take at most {10 * MOST_STEPS} steps of {step:.3g} with '{method}' (expm has no steps)", end
        )
    if step > limit * (1 + 1e-9):
        raise checks.fail(
            "step",
            f"be at most {limit:.6g} for '{method}' (|lambda| step <= {edge:.4g}, fastest rate {fastest:.4g})",
            step,
        )
    if growth(integrator, eigenvalues, step, end) > 1:
        raise checks.fail(
            "step", f"keep oscillations that decay from growing by '{method}' up to time {end:g} (expm has no steps)", step
        )
    return step


def growth(integrator: Integrator, eigenvalues: NDArray[np.complex128], step: float, end: float) -> float:
    """Largest exponent by which a mode that does not grow has grown at the end by steps of a Runge-Kutta method."""
    if integrator.order is None or integrator.name.endswith("adams"):
        return 0.0
    z = eigenvalues[eigenvalues.real <= 1e-12 * np.abs(eigenvalues).max()] * step
    factor = np.abs(sum(z**k / math.factorial(k) for k in range(integrator.order + 1)))
    return float(np.log(factor.max(initial=1.0)) * end / step)


def _solver(integrator: Integrator) -> Solver:
    name = integrator.name
    if name == "scipy_solver":
        return Solver(name, _ode(integrator), "torchdiffeq, SciPy's solvers", ("rtol", "atol", "solver"))
    if integrator.adaptive:
        return Solver(name, _ode(integrator), "torchdiffeq, adaptive step", ("rtol", "atol"))
    options = ("step", "rtol", "atol") if name.endswith("adams") else ("step",)
    return Solver(name, _ode(integrator), "torchdiffeq, fixed step", options)


STABILITY = {entry.name: stability_limit(entry) for entry in INTEGRATORS.values() if not entry.adaptive}
"""Largest |lambda| step of every method with a fixed step."""

SOLVERS: dict[str, Solver] = {
    "expm": Solver("expm", expm, "matrix exponential, exact"),
    **{name: _solver(integrator) for name, integrator in INTEGRATORS.items()},
}
