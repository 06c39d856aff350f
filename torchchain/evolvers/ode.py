"""General-purpose integrators of torchdiffeq and scipy, as peers to compare the chain's own methods with.

All integrate the first-order form d/dt (u, v, E) = (v, M^-1 (F - D v), power lost), with the energy lost to damping E
in the place of one more particle, in units of the start's amplitude so that one tolerance fits all. Linear and Hertz
contacts, damping and gradients come with that; symplecticity does not, and the energy is watched instead.

``openings`` counts the different contacts found open at the start of any accepted step (for ``lsoda``, at any
evaluation) or at any output, up to each time. An open Hertz contact does not damp.

A batch shares its steps, chosen for its most demanding state: a chain's result depends on what it is batched with,
within the tolerance. The chain's own methods do not have that, nor has a fixed ``step`` that is given.

torchdiffeq's ``euler`` is left out: it multiplies the amplitude of a mode by 1 + (w step)^2 / 2 at every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers import energy_guard
from torchchain.evolvers.method import Advance, Method, targets_of
from torchchain.evolvers.symplectic import (
    check_limits,
    damping_rate,
    highest_frequency,
    initial_overlap,
    largest_overlap,
    substeps,
)
from torchchain.odes import INTEGRATORS, IntegrationError, Integrator, member_norm, step_grid

ALLOWED_CHANGE = 0.1  # of the energy, relative, before it is an error


class _Motion:
    """The right-hand side, which also sees every step and notes when each Hertz contact first opens."""

    def __init__(self, chain: Chain, state: State) -> None:
        self.chain = chain
        self.n = chain.n_particles
        self.weight = 1 / chain.align(chain.masses, state.displacement)
        self.hertz, self.damped = chain.contact == "hertz", chain.is_damped
        amplitude = torch.stack([state.displacement, state.velocity]).detach().abs().amax((0, -1))
        self.amplitude = torch.where(amplitude > 0, amplitude, 1.0)  # (*batch, *any)
        self.opened_at = torch.full_like(chain.elongation(state.displacement.detach()), math.inf)
        self.since, self.note_calls = 0.0, False

    def __call__(self, t: Tensor, y: Tensor) -> Tensor:
        if self.note_calls:
            self.note(self.since + t.item(), y)
        displacement, velocity = y[..., : self.n], y[..., self.n : 2 * self.n]
        tension = self.chain.tension(self.chain.elongation(displacement))
        rates = [velocity]
        if self.damped:
            rate = self.chain.elongation(velocity)
            damping = self.chain.active_damping(displacement)
            tension = tension + damping * rate
            power = ((damping * rate.square()).sum(-1) / self.amplitude)[..., None]
        rates.append(self.weight * self.chain.net(tension))
        return torch.cat([*rates, power] if self.damped else rates, dim=-1)

    def note(self, t: float, y: Tensor) -> None:
        """Remember the contacts that are open at a time."""
        if self.hertz:
            opened = self.chain.open_contacts(y[..., : self.n].detach())
            self.opened_at = torch.where(opened, self.opened_at.clamp(max=t), self.opened_at)

    def note_step(self, t: Tensor, y: Tensor, dt: Tensor) -> None:
        """What torchdiffeq calls at the start of a step, its t counted from the start of the window."""
        self.note(self.since + t.item(), y)


@dataclass(frozen=True)
class _Solver(Integrator):
    """An integrator as it is called and told here; rtol is a power of eps."""

    method: str = ""  # torchdiffeq's name for it
    stability: str = "by its error estimate"
    rtol: float = 0.5
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def limit(self) -> float | None:
        """Of w_max step."""
        return self.swing_limit or None

    @property
    def damping_limit(self) -> float | None:
        """Of d_max step."""
        return self.decay_limit if self.swing_limit else None


def _evolve(
    chain: Chain,
    state: State,
    integrate: Callable[[_Motion, Tensor, float, list[float]], list[Tensor]],
    remedy: str,
) -> Advance:
    """The evolution by ``integrate(motion, y, now, times)``, which returns y at each of the times after ``now``."""
    dtype = torch.promote_types(chain.masses.dtype, state.displacement.dtype)
    chain = replace(chain, masses=chain.masses.to(dtype))
    state = State(state.displacement.to(dtype), state.velocity.to(dtype))
    motion = _Motion(chain, state)
    n = chain.n_particles
    initial = chain.energy(state.displacement, state.velocity).detach()
    y = torch.cat([state.displacement, state.velocity], dim=-1)
    if motion.damped:
        y = torch.cat([y, torch.zeros_like(y[..., :1])], dim=-1)
    now = 0.0

    def advance(times: Tensor) -> Trajectory:
        nonlocal y, now
        targets = targets_of(times, now)
        ahead = [target for target in targets if target > now]
        motion.note(now, y)
        series = [y] * (len(targets) - len(ahead)) + (integrate(motion, y, now, ahead) if ahead else [])
        for target, values in zip(targets, series, strict=True):
            motion.note(target, values)
        y, now = series[-1], targets[-1]
        stacked = torch.stack(series, dim=-2)
        openings = None
        if motion.hertz:
            openings = torch.stack([(motion.opened_at <= target).sum(-1) for target in targets], dim=-1)
        trajectory = Trajectory(
            times,
            stacked[..., :n],
            stacked[..., n : 2 * n],
            stacked[..., -1] * motion.amplitude[..., None] if motion.damped else None,
            openings,
        )
        energy_guard.check(chain, trajectory, initial, ALLOWED_CHANGE, remedy)
        return trajectory

    return advance


def _start_adaptive(
    solver: _Solver, chain: Chain, state: State, rtol: float | None = None, atol: float | None = None
) -> Advance:
    """See the registry entries below."""
    from torchdiffeq import odeint

    eps = torch.finfo(chain.masses.dtype).eps
    rtol = min(eps**solver.rtol, 1e-3) if rtol is None else checks.number("rtol", rtol, at_least=4 * eps, below=1)
    atol = None if atol is None else checks.number("atol", atol, above=0)
    if solver.name == "lsoda" and torch.is_grad_enabled():
        for name in ("masses", "stiffness", "damping"):
            _refuse_gradient(name, torch.as_tensor(getattr(chain, name)), solver.name)
        for name in ("displacement", "velocity"):
            _refuse_gradient(name, getattr(state, name), solver.name)

    def integrate(motion: _Motion, y: Tensor, now: float, times: list[float]) -> list[Tensor]:
        grid = torch.tensor([0.0, *(time - now for time in times)], dtype=torch.float64, device=y.device)
        motion.since, motion.note_calls = now, solver.name == "lsoda"
        options = dict(solver.options)
        absolute = (rtol * motion.amplitude)[..., None].expand(y.shape) if atol is None else torch.tensor(atol).to(y)
        if not motion.note_calls:
            motion.callback_accept_step = motion.note_step  # type: ignore[attr-defined]
            # Outputs that are steps: what it interpolates from is less accurate than its steps.
            options |= {"norm": member_norm, "step_t": grid[1:]}
        try:
            series = odeint(
                motion,
                y,
                grid,
                rtol=rtol,
                atol=absolute.cpu().flatten().numpy() if motion.note_calls else absolute,
                method=solver.method,
                options=options,
            )
        except AssertionError as error:
            raise IntegrationError(f"method '{solver.name}' gave up with rtol {rtol:.1e}: {str(error)[:80]}") from error
        if len(series) < len(grid):
            raise IntegrationError(f"method '{solver.name}' gave up with rtol {rtol:.1e} before time {times[-1]:g}")
        return list(series[1:])

    return _evolve(chain, state, integrate, f"method '{solver.name}' with rtol {rtol:.1e}: use a smaller rtol")


def _refuse_gradient(field: str, value: Tensor, method: str) -> None:
    if value.requires_grad:
        raise checks.fail(field, f"not require a gradient for method '{method}'", "requires_grad=True")


def _start_fixed(solver: _Solver, chain: Chain, state: State, step: float | None = None) -> Advance:
    """See the registry entries below."""
    from torchdiffeq import odeint

    if step is None:
        step = 0.1 / highest_frequency(chain, largest_overlap(chain, state)).amax().item()
        if chain.is_damped:
            step = min(step, 0.1 / damping_rate(chain).amax().item())
    step = checks.number("step", step, above=0)
    rates = [("w_max", solver.limit, highest_frequency(chain, initial_overlap(chain, state)))]
    if chain.is_damped:
        rates.append(("d_max", solver.damping_limit, damping_rate(chain)))
    check_limits(step, solver.name, rates)

    def integrate(motion: _Motion, y: Tensor, now: float, times: list[float]) -> list[Tensor]:
        series: list[Tensor] = []
        motion.callback_step = motion.note_step  # type: ignore[attr-defined]
        counts = substeps(now, times, step).tolist()
        starts = [now, *times[:-1]]
        lengths = [(end - begin) / count for begin, end, count in zip(starts, times, counts, strict=True)]
        first = 0
        while first < len(times):
            # Multistep methods assume equal steps, so that a change of their length is a fresh start.
            last = first + 1
            while last < len(times) and abs(lengths[last] - lengths[first]) < 1e-9 * lengths[first]:
                last += 1
            motion.since = starts[first]
            outputs = [0.0, *(time - starts[first] for time in times[first:last])]
            grid = step_grid(outputs, counts[first:last]).to(y.device)
            t = torch.tensor(outputs, dtype=torch.float64, device=y.device)
            found = odeint(
                motion,
                y,
                t,
                rtol=1e3,  # a corrector that does not iterate meets any
                atol=1e3,
                method=solver.method,
                options={**solver.options, "grid_constructor": lambda *_, grid=grid: grid},
            )
            series += found[1:]
            y, first = series[-1], last
        return series

    return _evolve(chain, state, integrate, f"method '{solver.name}' with step {step:.4g}: use a smaller step")


NO_STEP = (
    "no step is stable on an undamped chain: the amplitude of a mode grows by a factor of 1 + {growth} at every step"
)


def _solver(method: str, **told: Any) -> _Solver:
    """An integrator with its own facts, but for those that are told."""
    return _Solver(**{**vars(INTEGRATORS[method]), "method": method, **told})


ADAPTIVE = (
    _solver("dopri5"),
    _solver("dopri8"),
    _solver("bosh3", rtol=0.4),
    _solver("adaptive_heun", rtol=0.3),
    _solver("fehlberg2", rtol=0.4),
    _solver("scipy_solver", name="lsoda", summary="LSODA, Adams of variable order", evaluations=2),
)
ADAMS = {"max_order": 5}  # the number of slopes that torchdiffeq keeps, one more than it uses
FIXED = (
    _solver("midpoint", stability=NO_STEP.format(growth="(w step)^4 / 8")),
    _solver("heun2", stability=NO_STEP.format(growth="(w step)^4 / 8")),
    _solver("heun3", stability="w_max step < 1.732"),
    _solver("rk4", stability="w_max step < 2.828"),
    _solver("explicit_adams", stability="w_max step < 0.43", options=ADAMS),
    # An explicit predictor corrected once, not iterated.
    _solver(
        "implicit_adams",
        summary="Adams, Bashforth and Moulton with four past steps, corrected once",
        stability=NO_STEP.format(growth="0.1 (w step)^6") + ", and w_max step must be less than 1",
        options=ADAMS, order=5, evaluations=2, swing_limit=1.0, decay_limit=1.41,
    ),
)  # fmt: skip


def _entry(solver: _Solver, start: Callable[..., Advance], options: dict[str, str]) -> Method:
    adaptive, gradient = solver.adaptive, solver.name != "lsoda"
    loss = "keep energy: it changes steadily, and by more than a tenth is an error"
    return Method(
        name=solver.name,
        start=partial(start, solver),
        summary=f"{solver.summary}, {'adaptive, ' if adaptive else ''}from {'torchdiffeq' if gradient else 'scipy'}",
        order=f"{solver.order}" if solver.order else "variable, up to 12",
        conserves="momentum",
        stability=solver.stability + ("" if adaptive else "; the energy is watched"),
        cost=f"{'' if gradient else 'about '}{solver.evaluations} forces per step, N each",
        cannot=loss if gradient else f"{loss}; gradients; other devices than the CPU, where it does its work",
        contacts=("linear", "hertz"),
        damped=True,
        traced=False,
        options=options,
        candidate=solver.name == "dopri8",
        order_in_step=None if adaptive else solver.order,
        forces_per_step=solver.evaluations or 1,
        stability_limit=solver.limit,
    )


METHODS = tuple(
    _entry(
        solver,
        _start_adaptive,
        {
            "rtol": f"relative error per step (default {torch.finfo(torch.float64).eps ** solver.rtol:.1g} in float64)",
            "atol": "absolute error per step (default rtol times each start's largest displacement or velocity)",
        },
    )
    for solver in ADAPTIVE
) + tuple(
    _entry(
        solver,
        _start_fixed,
        {"step": "largest step; outputs are reached by equal steps of at most that (default 0.1 / w_max of the batch)"},
    )
    for solver in FIXED
)
