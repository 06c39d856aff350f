"""Chebyshev propagation: exact to rounding, by nothing but the chain's own stencil (Eqs. 13, 20).

With A = -M^-1 K, a squared frequency W^2 that no mode exceeds, x = 1 - 2 A / W^2 and z = W t,

    cos(sqrt(A) t) = J_0(z) + 2 sum_k J_2k(z) T_k(x),

(Tal-Ezer, SIAM J. Numer. Anal. 23, 11, 1986; Kosloff et al., Geophys. Prospecting 37, 383, 1989): a polynomial in A
of a degree that is z / 2 and a few more. A start (u, v) needs it, its time integral and its time derivative, which
are sums over the same T_k; :mod:`coefficients` has theirs. No matrix is formed.

The times are crossed in *segments*; see :data:`LEAP`. The sums leave out coefficients that add up to no more than
accuracy / 1024, or half an ulp where that is larger, in each segment. As |T_k(x)| <= 1 on the spectrum, what is left
out is at most that share of the state's size, sqrt(W^2 |u|^2 + |v|^2) in the norm of Eq. 18, and since the motion
conserves energy these shares add up at worst: the truncation stays below ``accuracy`` for 1024 segments. Rounding
errors come on top: against 40 digits, some 1e-14 at t = 50 and 1e-13 to 1e-11 at t = 1000.

This file holds the plain torch implementation: the reference, for any device and for gradients. On the CPU the Numba
kernels of :mod:`stencil` do the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.evolvers.expansion import LEAP, ROUNDING, SEGMENTS
from torchchain.evolvers.method import Advance, Method
from torchchain.modes import phase
from torchchain.modes.localization import negative_pivots
from torchchain.threads import kept_property, side_by_side

if TYPE_CHECKING:
    from torchchain.evolvers.stencil import Propagation, Rows

SWEEPS = 8  # of the bound's power iteration: within 2 % of the highest frequency, or of 30 sweeps
WASTE = 1e4  # a bound beyond so many times the chain's own is a mistake
MOST_PHASE = 1e10  # W t, twice the number of stencils


def start(
    chain: Chain,
    state: State,
    accuracy: float = 1e-12,
    bound: float | Tensor | None = None,
    compiled: bool | None = None,
) -> Advance:
    """See the registry entry below.

    Raises:
        FieldError: for an option out of range; for a ``bound`` that a squared frequency of the chain exceeds.
    """
    tensors = (chain.masses, chain.contact_stiffness, state.displacement, state.velocity)
    tolerance, compiled = settled(accuracy, compiled, tensors)
    if compiled:
        frequency = None if bound is None else highest_frequency(chain, bound)
        return CompiledAdvance(chain, state, frequency, tolerance)
    return expanded(chain, state, highest_frequency(chain, bound), tolerance, Trajectory)


def settled(accuracy: float, compiled: bool | None, tensors: Iterable[Tensor]) -> tuple[float, bool]:
    """What truncation may leave out in a segment, and whether the Numba kernels run, which cannot treat all tensors."""
    accuracy = checks.number("accuracy", accuracy, above=0, at_most=0.1)
    possible = all(
        x.device.type == "cpu"
        and x.dtype in (torch.float32, torch.float64)
        and not (x.requires_grad and torch.is_grad_enabled())
        and not checks.is_transformed(x)
        for x in tensors
    )
    if not isinstance(compiled, bool | None):
        raise checks.FieldTypeError(f"compiled must be True, False or None, got {checks.shown(compiled)}")
    if compiled and not possible:
        raise checks.fail("compiled", "be False for tensors off the CPU, or that require gradients", compiled)
    return max(accuracy / SEGMENTS, ROUNDING), possible if compiled is None else compiled


def highest_frequency(chain: Chain, bound: float | Tensor | None = None) -> Tensor:
    """W, at least the highest frequency of each chain, (*batch,), float64.

    Args:
        chain: linear contacts.
        bound: of the squared frequency, a number or (*batch,); by default the chain's own, which is rigorous.

    Raises:
        FieldError: if a squared frequency exceeds the ``bound``.
    """
    double = chain if chain.masses.dtype == torch.float64 else replace(chain, masses=chain.masses.double())

    def exceeded(squared: Tensor) -> Tensor:
        rule = f"be at most {WASTE:g} times chain.squared_frequency_bound(): work grows as its root"
        checks.first_bad("bound", rule, squared, squared > WASTE * double.squared_frequency_bound(SWEEPS), "chain")
        # A margin for rounding; no single high mode escapes a count of all of them.
        return negative_pivots(double, (squared * (1 + 1e-12))[..., None])[..., 0] < chain.n_particles

    return bounding_frequency(double, "chain", bound, exceeded)


def bounding_frequency(
    system: Any, kind: str, bound: float | Tensor | None, exceeded: Callable[[Tensor], Tensor]
) -> Tensor:
    """:func:`highest_frequency` of chains or networks, the ``kind``, and of which squared frequencies are ``exceeded``."""
    with torch.no_grad():
        batch, device = system.batch_shape, system.masses.device
        if bound is None:
            squared = system.squared_frequency_bound(SWEEPS).to(torch.float64)
        else:
            given = checks.real_tensor("bound", bound).to(device, torch.float64)
            checks.first_bad("bound", "be positive", given, given <= 0)
            if given.shape not in (torch.Size(), batch):
                raise checks.fail("bound", f"be a number or have shape {tuple(batch)}", given)
            squared = given.expand(batch)
            rule = f"not lie below the largest squared frequency ({kind}.squared_frequency_bound() never does)"
            checks.first_bad("bound", rule, squared, exceeded(squared), kind)
        if checks.is_transformed(squared):  # one bound for all that vmap runs at once
            squared = checks.traced_values(squared).amax().expand(batch)
        squared = squared.clamp(min=1e-300)  # of a network without bonds: any W will do
        return torch.as_tensor(rounded_up(_numbers(squared.sqrt())), device=device)


def _numbers(values: Tensor) -> np.ndarray:
    """The values of a tensor, also within ``torch.func``, where NumPy cannot share its memory."""
    return np.array(checks.traced_values(values).tolist(), np.float64)


def rounded_up(frequency: np.ndarray) -> np.ndarray:
    """Rounded up to 24 bits: W^2 and most W t are exact then, and the operator and its time fit to the last bit."""
    mantissa, exponent = np.frexp(frequency)
    return np.ldexp(np.ceil(mantissa * 2**24) / 2**24, exponent)


def check_work(times: Tensor, frequency: float) -> None:
    """An error where W t asks for more stencils than anyone waits for; the rounding of W t is far from felt there."""
    end = times.detach().amax().item()
    if not frequency * end <= MOST_PHASE:
        raise checks.fail(
            "times",
            f"be at most {MOST_PHASE / frequency:.3g} for method 'chebyshev', which takes W t / 2 stencils (W t <= "
            f"{MOST_PHASE:.0e}, W = {frequency:.4g} being set by the lightest particles)",
            end,
        )


def expanded(system: Any, state: State, frequency: Tensor, tolerance: float, trajectory: type[Trajectory]) -> Advance:
    """The expansion in plain torch, from each output time to the next.

    Args:
        system: a chain or a network.
        state: its start.
        frequency: W, (*batch,).
        tolerance: what truncation may leave out of a leap.
        trajectory: what its states in time are.
    """
    from torchchain.evolvers.coefficients import coefficients_of  # imports Numba

    axis = frequency.ndim
    pair = torch.stack([state.displacement, state.velocity], dim=axis)
    weight = system.align((4 / frequency.square()).to(system.masses)[..., None] / system.masses, pair)
    ahead = (None,) * (pair.ndim - axis - 1)  # axes of a state behind the batch
    frequencies = _numbers(frequency.reshape(-1))
    now = 0.0

    def step(pair: Tensor, time: np.ndarray) -> Tensor:
        table = torch.from_numpy(coefficients_of(frequencies, time, tolerance)).to(pair)
        table = table.reshape(*table.shape[:2], *frequency.shape)[(..., *ahead)]
        older, old = pair, pair + weight / 2 * system.force(pair)
        total: list[Tensor] = []
        for k in range(table.shape[1]):
            if k > 1:
                older, old = old, 2 * old - older + weight * system.force(old)
            displacement, velocity = (pair if k == 0 else old).unbind(axis)
            cosine, integral, derivative = table[:, k]
            terms = [cosine * displacement + integral * velocity, cosine * velocity + derivative * displacement]
            total = [a + b for a, b in zip(total, terms, strict=True)] if total else terms
        return torch.stack(total, dim=axis)

    def advance(times: Tensor) -> Any:
        nonlocal pair, now
        check_work(times, frequencies.max())
        phase.check(times, frequency, pair.dtype)
        outputs = []
        for t in later_times(times, now).tolist():
            # Each realization takes the leaps it needs by itself, and then rests.
            leaps = np.ceil(frequencies * (t - now) / LEAP)
            for leap in range(int(leaps.max())):
                pair = step(pair, np.where(leap < leaps, (t - now) / np.maximum(leaps, 1), 0.0))
            now = t
            outputs.append(pair)
        displacement, velocity = torch.stack(outputs, dim=-1 - len(trajectory.axes_of_a_state)).unbind(axis)
        return trajectory(times, displacement, velocity)

    return advance


def later_times(times: Tensor, now: float) -> Tensor:
    """The times as float64 on the CPU, none before those of the last window."""
    if bool(times[0] < now):
        raise checks.fail("times", f"not go back behind the last window's end {now:g}", times[0].item())
    return checks.traced_values(times.detach().to("cpu", torch.float64))


class CompiledAdvance:
    """The expansion by the kernels of :mod:`stencil`, in float64 whatever the dtype of the state."""

    def __init__(self, chain: Chain, state: State, frequency: Tensor | None, tolerance: float) -> None:
        from torchchain.evolvers import stencil  # imports Numba

        n = chain.n_particles

        def plain(x: Tensor) -> np.ndarray:
            return x.detach().double().reshape(-1, x.shape[-1]).contiguous().numpy()

        masses, springs = plain(chain.masses), plain(chain.in_a_row(chain.contact_stiffness))
        states = torch.stack([state.displacement.detach(), state.velocity.detach()], dim=-2)
        if frequency is None:
            squared, count = np.empty(len(masses)), len(masses)
            side_by_side(
                lambda *rows: stencil.squared_bounds(*rows, masses, springs, chain.is_free, SWEEPS, squared), count
            )
            frequencies = rounded_up(np.sqrt(squared))
        else:
            frequencies = frequency.reshape(-1).numpy()
        self.rows: Rows = stencil.Rows(
            masses=masses,
            contacts=springs,
            rigid_masses=plain(chain.rigid_mass[..., None])[:, 0],
            frequencies=frequencies,
            states=states.double().reshape(-1, 2, n).numpy(),
            starts=math.prod(state.displacement.shape[:-1]) // len(masses),
            periodic=chain.is_free,
            tolerance=tolerance,
        )
        self._shape, self._n, self._dtype = state.displacement.shape[:-1], n, state.displacement.dtype
        self._now = 0.0

    @kept_property
    def _propagation(self) -> Propagation:
        from torchchain.evolvers import stencil

        return stencil.Propagation(self.rows)

    def check_work(self, times: Tensor) -> None:
        """See :func:`check_work`."""
        check_work(times, float(self.rows.frequencies.max()))

    def __call__(self, times: Tensor) -> Trajectory:
        from torchchain.evolvers import records

        self.check_work(times)
        later = later_times(times, self._now)
        out = torch.empty((2, self.rows.count, len(later), self._n), dtype=self._dtype)
        steps, states = later.numpy(), out.numpy()
        side_by_side(
            lambda begin, end: self._propagation.fields(begin, end, steps, records.STATES, states), self.rows.count
        )
        self._now = later[-1].item()
        displacement, velocity = out.reshape(2, *self._shape, len(later), self._n)
        return Trajectory(times, displacement, velocity)


METHOD = Method(
    name="chebyshev",
    start=start,
    summary="Chebyshev expansion of the exact solution in powers of the stencil, without matrices",
    order="exact to the accuracy asked for, at any output time",
    conserves="energy and, on a ring, momentum, to the accuracy; time reversal and reciprocity likewise",
    stability="unconditional: the spectrum lies below a rigorous bound, and a bound that is too small is refused",
    cost="about W t / 2 stencils and 4 W sums of N numbers per unit of time (W: highest frequency); memory of a state",
    cannot="damping, Hertz contacts",
    candidate=True,
    compiled=True,
    options={
        "accuracy": "what truncation may leave out, relative to the size of the state, over 1024 segments (1e-12)",
        "bound": "squared frequency that no mode exceeds, a number or (*batch,); by default a rigorous one",
        "compiled": "False for the plain torch implementation on the CPU, too",
    },
)
