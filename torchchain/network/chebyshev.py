"""Chebyshev propagation of networks: exact to rounding, by products with the bonds alone.

The expansion of a chain (:mod:`torchchain.evolvers.chebyshev`, whose coefficients serve here) needs nothing of the
chain but its force and a bound W^2 that no squared frequency exceeds: T_k = T_k(1 - 2 M^-1 K / W^2).

On the CPU the kernels of :mod:`torchchain.network.kernels` do it, in float64; elsewhere, and where gradients are asked
for, plain torch. Outputs that follow a state closely share one recursion.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain.chain import State
from torchchain.evolvers.chebyshev import METHOD as CHAINS
from torchchain.evolvers.chebyshev import bounding_frequency, check_work, expanded, later_times, settled
from torchchain.evolvers.expansion import LEAP, LONGEST, SHARED_PHASE
from torchchain.evolvers.method import Advance
from torchchain.modes import phase
from torchchain.network.layouts import Run, layout_of
from torchchain.network.modes import check_stability, exceeds
from torchchain.network.networks import Network
from torchchain.network.trajectories import NetworkTrajectory

SPLIT = 20_000  # unknowns from which the threads share one network


def start(
    network: Network,
    state: State,
    accuracy: float = 1e-12,
    bound: float | Tensor | None = None,
    compiled: bool | None = None,
) -> Advance:
    """See the registry entry below.

    Raises:
        FieldError: for an option out of range.
        UnstableError: for a network that is not stable.
    """
    values = (network.masses, network.stiffness, network.tension, network.positions, state.displacement, state.velocity)
    tolerance, compiled = settled(accuracy, compiled, map(torch.as_tensor, values))
    check_stability(network)
    frequency = highest_frequency(network, bound)
    if compiled:
        return CompiledAdvance(network, state, frequency, tolerance)
    return expanded(network, state, frequency, tolerance, NetworkTrajectory)


def highest_frequency(network: Network, bound: float | Tensor | None = None) -> Tensor:
    """W, at least the highest frequency of each network, (*batch,), float64.

    Args:
        network: any.
        bound: of the squared frequency, a number or (*batch,); by default the network's own, which is rigorous.

    Raises:
        FieldError: if a squared frequency exceeds the ``bound``, which would make states grow without limit.
    """

    def exceeded(squared: Tensor) -> Tensor:
        found = torch.zeros(network.batch_shape, dtype=torch.bool, device=squared.device)
        for member in np.ndindex(*network.batch_shape):
            found[member] = exceeds(network, float(squared[member]), member)
        return found

    return bounding_frequency(network, "network", bound, exceeded)


class CompiledAdvance:
    """The expansion by the kernels, in float64 whatever the dtype of the state."""

    def __init__(self, network: Network, state: State, frequency: Tensor, tolerance: float) -> None:
        self.layout = layout_of(network)
        self.frequencies = frequency.reshape(-1).cpu().numpy()
        self.tolerance = tolerance
        self._shape, self._dtype = state.displacement.shape, state.displacement.dtype
        n, c = self._shape[-2:]
        pair = torch.stack([state.displacement.detach(), state.velocity.detach()], dim=-3)
        self._anchors = pair.double().reshape(-1, 2, n, c).numpy()
        self._starts = len(self._anchors) // max(len(self.frequencies), 1)
        self._unknowns = n * c
        self._now = 0.0

    def __call__(self, times: Tensor) -> NetworkTrajectory:
        check_work(times, float(self.frequencies.max()))
        phase.check(times, torch.from_numpy(self.frequencies), torch.float64)
        later = later_times(times, self._now).tolist()
        rows = len(self._anchors)
        n, c = self._shape[-2:]
        out = torch.empty((2, rows, len(later), n, c), dtype=self._dtype)
        anchors = np.empty_like(self._anchors)
        threads = torch.get_num_threads()

        def one(row: int, pool: ThreadPoolExecutor | None) -> None:
            anchors[row] = self._march(row, later, out[:, row], pool, threads)

        if threads == 1 or (rows == 1 and self._unknowns < SPLIT):
            for row in range(rows):
                one(row, None)
        else:
            with ThreadPoolExecutor(threads) as pool:
                if rows >= threads or self._unknowns < SPLIT:
                    list(pool.map(lambda row: one(row, None), range(rows)))
                else:
                    for row in range(rows):
                        one(row, pool)
        self._anchors, self._now = anchors, later[-1]
        displacement, velocity = out.reshape(2, *self._shape[:-2], len(later), n, c)
        return NetworkTrajectory(times, displacement, velocity)

    def _march(
        self, row: int, times: list[float], out: Tensor, pool: ThreadPoolExecutor | None, threads: int
    ) -> np.ndarray:
        """Writes the states of a row at the times, and returns the last in float64."""
        member = row // self._starts
        w = float(self.frequencies[member])
        run = self.layout.bind(member, w)
        state, now, done = self._anchors[row], self._now, 0
        while done < len(times):
            if times[done] == now:
                out[:, done] = torch.from_numpy(state)
                done += 1
                continue
            count = 1
            while count < LONGEST and done + count < len(times) and w * (times[done + count] - now) <= SHARED_PHASE:
                count += 1
            leaps = max(1, math.ceil(w * (times[done] - now) / LEAP)) if count == 1 else 1
            for leap in range(1, leaps + 1):
                share = [(t - now) * leap / leaps - (t - now) * (leap - 1) / leaps for t in times[done : done + count]]
                states = self._expand(run, state, w, np.array(share), pool, threads)
                state = states[-1]
            out[:, done : done + count] = torch.from_numpy(states).transpose(0, 1)
            now, done = times[done + count - 1], done + count
        return state

    def _expand(
        self, run: Run, state: np.ndarray, w: float, intervals: np.ndarray, pool: Any, threads: int
    ) -> np.ndarray:
        """States (output, 2, particle, component) at some intervals after a state."""
        from torchchain.evolvers.coefficients import coefficients_of  # imports Numba

        cosine, integral, derivative = coefficients_of(np.full(len(intervals), w), intervals, self.tolerance)
        kinds = [kind for kind in (0, 1) if state[kind].any()] or [0]
        count = max(2, len(cosine))
        table = np.zeros((len(intervals), count, 2, len(kinds)))  # (output, term, displacement or velocity, field)
        for r, kind in enumerate(kinds):
            for to, factor in enumerate((cosine, derivative) if kind == 0 else (integral, cosine)):
                table[:, : len(factor), to, r] = factor.T
        cells, sums = self.layout.cells([state[kind] for kind in kinds]), self.layout.sums(len(intervals))
        last, parts = count - 1, self.layout.parts
        if pool is None:
            run((1, count), last, 0, parts, cells, sums, table)
        else:
            cuts = [parts * i // threads for i in range(threads + 1)]
            for k in range(1, count):
                list(
                    pool.map(
                        lambda i, k=k: run((k, k + 1), last, cuts[i], cuts[i + 1], cells, sums, table), range(threads)
                    )
                )
        return self.layout.read(sums)


METHOD = replace(
    CHAINS,
    start=start,
    summary="Chebyshev expansion of the exact solution in powers of M^-1 K, by the bonds alone",
    conserves="energy and, without anchors, momentum, to the accuracy",
    stability="unconditional: the spectrum lies below a rigorous bound; networks that are not stable are refused",
    cost="about W t / 2 products with the bonds and some sums per output (W: the bound); memory of a few states",
    cannot="damping, contacts that open",
)
