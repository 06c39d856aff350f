"""Symplectic compositions of drifts and kicks, shared by the methods ``verlet`` and ``symplectic4``.

A drift moves the particles at constant velocity, a kick changes the velocities by the contact forces at rest; each is
solved exactly, so any sequence of them is symplectic. Two implementations are tested to be equal: plain torch, which
is differentiable and runs on any device, and a numba loop for CPU tensors that need no gradient.

``openings`` counts the different contacts found open at any evaluation of the forces (in ``verlet``, every step) or at
any output, up to each time. An open Hertz contact does not damp. Every state of a batch takes the steps that it would
take alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.amplitude import elongation_bound
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers import energy_guard
from torchchain.evolvers.method import Advance, targets_of

Pair = tuple[float, float]

MOST_STEPS = 1e10
"""From one output time to the next, for methods with a step."""


@dataclass(frozen=True)
class Composition:
    """One step as drifts and kicks, each for a fraction of the step: (drift, kick), (drift, kick), ...

    Attributes:
        opening, middle, closing: the pairs; the opening's follow the closing's of the step before.
        limit: largest stable w h, w the highest frequency and h the step.
        default: w h where no step is given.
    """

    opening: Pair
    middle: tuple[Pair, ...]
    closing: Pair
    limit: float
    default: float


def highest_frequency(chain: Chain, overlap: Tensor | float = 1.0) -> Tensor:
    """An upper bound on the frequencies of contacts with at most this overlap (initially 1), (*batch,) or as the overlap.

    A Hertz contact is stiffer than at the initial overlap by the square root of its overlap, (*batch, *any).
    """
    with torch.no_grad():
        squared = chain.squared_frequency_bound()
        if chain.contact == "hertz":
            overlap = torch.as_tensor(overlap)
            squared = squared[(..., *[None] * (overlap.ndim - squared.ndim))] * overlap.clamp(min=1).sqrt()
        return squared.sqrt()


def damping_rate(chain: Chain) -> Tensor:
    """An upper bound on the eigenvalues of M^-1 D, (*batch,)."""
    with torch.no_grad():
        damping = chain.contact_damping
        # The bound for stiffness serves; a contact without damping gets as little as makes no difference.
        least = (1e-12 * damping.amax(-1, keepdim=True)).clamp(min=torch.finfo(damping.dtype).tiny ** 0.5)
        as_stiffness = torch.maximum(damping, least)
        return replace(chain, stiffness=as_stiffness, contact="linear", damping=0.0).squared_frequency_bound()


def largest_overlap(chain: Chain, state: State) -> Tensor:
    """The largest overlap that the state's energy allows any Hertz contact, now and later, (*batch, *any)."""
    with torch.no_grad():
        return 1 + elongation_bound(chain, state)


def initial_overlap(chain: Chain, state: State) -> Tensor:
    """The largest overlap of any contact of the state, (*batch, *any)."""
    with torch.no_grad():
        return 1 - chain.elongation(state.displacement).amin(-1)


def _of_states(chain: Chain, values: Tensor, state: State) -> Tensor:
    """Values of the chains (*batch,) as values of their states (*batch, *any)."""
    members = state.displacement.ndim - 1 - values.ndim
    return values[(..., *[None] * members)].expand(state.displacement.shape[:-1])


def checked_step(chain: Chain, state: State, composition: Composition, method: str, step: float | None) -> Tensor:
    """The step of each state, (*batch, *any): the given one, if it is stable, or the default.

    The default is stable for any motion the state's energy allows, and does not depend on the rest of a batch.

    Raises:
        FieldError: for a step at or beyond the stability limit of the chain (at the start's overlaps for Hertz contacts).
    """
    damping = damping_rate(chain) if chain.is_damped else None
    if step is None:
        highest = highest_frequency(chain, largest_overlap(chain, state))
        default = composition.default / (highest if chain.contact == "hertz" else _of_states(chain, highest, state))
        return default if damping is None else torch.minimum(default, 0.5 / _of_states(chain, damping, state))
    step = checks.number("step", step, above=0)
    rates = [("w_max", composition.limit, highest_frequency(chain, initial_overlap(chain, state)))]
    if damping is not None:
        rates.append(("d_max", 2.0, damping))
    check_limits(step, method, rates)
    return torch.full(state.displacement.shape[:-1], step, dtype=torch.float64, device=state.displacement.device)


def check_limits(step: float, method: str, rates: Sequence[tuple[str, float | None, Tensor]]) -> None:
    """An error where the step times a rate reaches its limit; ``rates`` are (name, limit or None, value (*batch,))."""
    for name, limit, rate in rates:
        largest = rate.amax().item()
        if limit is not None and not step * largest < limit:
            raise checks.fail(
                "step",
                f"be less than {limit / largest:.6g}, the stability limit {limit:.6g} / {name} of method '{method}' "
                f"with {name} = {largest:.6g}{checks.position(checks.first(rate == largest) or ())}",
                step,
            )


def substeps(now: float, times: list[float], step: Tensor | float) -> np.ndarray:
    """How many equal steps of at most ``step`` (*any,) lead from each time to the next, the first from ``now``, (*any, time)."""
    spans = np.diff(times, prepend=now)
    with np.errstate(over="ignore"):
        ratio = spans / torch.as_tensor(step, dtype=torch.float64).cpu().numpy()[..., None]
    if not ratio.max() <= MOST_STEPS:
        where = tuple(int(i) for i in np.argwhere(ratio == ratio.max())[0])
        raise checks.fail(
            "times",
            f"lie at most {MOST_STEPS:.0e} steps apart (methods 'modes' and 'damped' have no steps)",
            f"{ratio.max():.3g}{checks.position(where[:-1])}",
        )
    # A ratio that only rounding puts above an integer does not cost another step.
    return np.ceil(ratio * (1 - 1e-9)).astype(np.int64)


def start(composition: Composition, method: str, chain: Chain, state: State, step: float | None = None) -> Advance:
    """The evolution by a composition, its step checked."""
    steps = checked_step(chain, state, composition, method, step)
    advance = stepping(chain, state, composition, steps)
    if chain.contact == "linear":
        return advance
    initial = chain.energy(state.displacement, state.velocity).detach()
    # A stable step lets the energy of a mode swing by (w h)^2 / 4 over 1 minus that in Verlet's case; more is a loss or gain that goes on.
    ratio = steps * highest_frequency(chain, initial_overlap(chain, state)) / composition.limit
    allowed = torch.where(ratio < 1, 0.1 + ratio**2 / (1 - ratio**2), 0.1)
    remedy = f"method '{method}' with step {steps.amax().item():.4g}: use a smaller step"

    def guarded(times: Tensor) -> Trajectory:
        trajectory = advance(times)
        energy_guard.check(chain, trajectory, initial, allowed, remedy)
        return trajectory

    return guarded


def stepping(chain: Chain, state: State, composition: Composition, step: Tensor | float) -> Advance:
    """The evolution by a composition with steps of at most ``step``, a number or one per state (*batch, *any).

    Nothing here checks them for stability.
    """
    dtype = torch.promote_types(chain.masses.dtype, state.displacement.dtype)
    chain = replace(chain, masses=chain.masses.to(dtype))
    state = State(state.displacement.to(dtype), state.velocity.to(dtype))
    tensors = (chain.masses, chain.contact_stiffness, chain.contact_damping, state.displacement, state.velocity)
    gradient = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    compiled = not gradient and chain.masses.device.type == "cpu" and dtype in (torch.float32, torch.float64)
    return (_rows if compiled else _tensors)(chain, state, composition, step)


def _tensors(chain: Chain, state: State, composition: Composition, step: Tensor | float) -> Advance:
    """Plain torch: any device, differentiable, new tensors at every step; a state that is done rests in steps of zero."""
    hertz, damped, dtype = chain.contact == "hertz", chain.is_damped, state.displacement.dtype
    weight = 1 / chain.align(chain.masses, state.displacement)
    displacement, velocity = state.displacement, state.velocity
    lost = torch.zeros_like(displacement[..., 0])
    peak = chain.elongation(displacement.detach())
    step = torch.as_tensor(step, dtype=torch.float64, device=displacement.device).expand(displacement.shape[:-1])
    now = 0.0

    def apply(*pairs: tuple[Pair, Tensor]) -> None:
        """Drifts and kicks for fractions of steps (*batch, *any, 1), those of several pairs at once."""
        nonlocal displacement, velocity, peak
        drifts, kicks = ([fraction[k] * h for fraction, h in pairs if fraction[k] != 0] for k in (0, 1))
        if drifts:
            displacement = displacement + torch.stack(drifts).sum(0) * velocity
        if kicks:
            elongation = chain.elongation(displacement)
            if hertz:
                peak = torch.maximum(peak, elongation.detach())
            velocity = velocity + torch.stack(kicks).sum(0) * weight * chain.net(chain.tension(elongation))

    def damp(duration: Tensor) -> None:
        nonlocal velocity, lost
        active = chain.active_damping(displacement)
        middle = velocity + duration / 2 * weight * chain.net(active * chain.elongation(velocity))
        pull = duration * chain.net(active * chain.elongation(middle))
        after = velocity + weight * pull
        lost = lost - (pull * (velocity + after)).sum(-1) / 2
        velocity = after

    def advance(times: Tensor) -> Trajectory:
        nonlocal now, peak
        targets, outputs = targets_of(times, now), []
        counts = torch.from_numpy(substeps(now, targets, step)).to(step.device)
        for target, count in zip(targets, counts.unbind(-1), strict=True):
            length = (target - now) / count.clamp(min=1).to(torch.float64)

            def of_step(number: int, count: Tensor = count, length: Tensor = length) -> Tensor:
                return torch.where(number < count, length, 0.0).to(dtype)[..., None]

            steps = int(count.amax())
            if damped and steps:
                damp(of_step(0) / 2)
            for i in range(steps):
                h, following = of_step(i), of_step(i + 1)
                if i == 0 or damped:
                    apply((composition.opening, h))
                for pair in composition.middle:
                    apply((pair, h))
                if damped:
                    apply((composition.closing, h))
                    damp((h + following) / 2)
                else:  # the end of a step and the start of the next are one drift and one kick
                    apply((composition.closing, h), (composition.opening, following))
            now = target
            if hertz:
                peak = torch.maximum(peak, chain.elongation(displacement.detach()))
            outputs.append((displacement, velocity, lost, (peak >= 1).sum(-1)))
        displacements, velocities, losses, openings = zip(*outputs, strict=True)
        return Trajectory(
            times,
            torch.stack(displacements, dim=-2),
            torch.stack(velocities, dim=-2),
            torch.stack(losses, dim=-1) if damped else None,
            torch.stack(openings, dim=-1) if hertz else None,
        )

    return advance


def _rows(chain: Chain, state: State, composition: Composition, step: Tensor | float) -> Advance:
    """The compiled loop: float32 or float64 on the CPU, no gradient."""
    from torchchain.evolvers.symplectic_kernel import advance_rows

    hertz, damped, n, lead = chain.contact == "hertz", chain.is_damped, chain.n_particles, state.displacement.shape[:-1]
    kind = np.float32 if chain.masses.dtype == torch.float32 else np.float64

    def of_chains(values: Tensor) -> np.ndarray:
        return values.detach().reshape(-1, values.shape[-1]).contiguous().numpy()

    moving = [x.detach().reshape(-1, n).numpy().copy() for x in (state.displacement, state.velocity)]
    rows = len(moving[0])
    numbers = (
        *moving, np.full((rows, n + 1), -np.inf, kind), np.zeros(rows, kind), of_chains(1 / chain.masses),
        *(of_chains(chain.in_a_row(values)) for values in (chain.contact_stiffness, chain.contact_damping)),
        chain.is_free, hertz, damped, np.array(composition.opening, kind), np.array(composition.middle, kind).reshape(-1, 2),
        np.array(composition.closing, kind),
    )  # fmt: skip
    longest = torch.as_tensor(step, dtype=torch.float64).expand(lead).reshape(-1)
    now = 0.0

    def advance(times: Tensor) -> Trajectory:
        nonlocal now
        targets = targets_of(times, now)
        counts = substeps(now, targets, longest)
        steps = (np.diff(targets, prepend=now) / np.maximum(counts, 1)).astype(kind)
        window = len(targets)
        out, losses, openings = np.empty((2, rows, window, n), kind), np.empty_like(steps), np.zeros_like(counts)
        advance_rows(*numbers, counts, steps, *out, losses, openings)
        now = targets[-1]
        displacement, velocity = torch.from_numpy(out).reshape(2, *lead, window, n)
        lost, opened = (torch.from_numpy(values).reshape(*lead, window) for values in (losses, openings))
        return Trajectory(times, displacement, velocity, lost if damped else None, opened if hertz else None)

    return advance
