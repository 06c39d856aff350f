"""Transfer with memory: a few decay rates shared by all pairs of bands, fitted by variable projection."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import optimize
from torch import Tensor

from torchchain import checks
from torchchain.master.model import Embedding, TransferModel, checked_basis, checked_damping

SLOWEST, FASTEST = 1e-4, 6.0
LADDER = ((1, 0), (1, 1), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (3, 6), (4, 6), (5, 8))
"""Orders that are tried one after the other: numbers of exponentials and of pairs."""


class MemoryModel(TransferModel):
    """T(t) = (Pi + sum_m A_m f_m(t)) exp(-d t), with sum_m A_m f_m(0) = I - Pi.

    The f_m are exp(-g t), or the pair exp(-g t) cos(w t), exp(-g t) sin(w t), the same for all pairs of bands. In
    the field's words a generalized master equation (Nakajima 1958, Zwanzig 1960): the rate at which a band loses
    energy depends on how long ago the energy came. It is Markovian again in an enlarged state of one copy of the bands
    for Pi and one for every f_m, in which it solves like any rate equation, from any start.

    Args:
        rates: Q [source, receiver] of the linear procedure at short times, for comparison; the prediction does not use it.
        basis: Pi [source, receiver].
        amplitudes: A_m [function, source, receiver], the exponentials first, then cosine and sine of every pair.
        decay: g of the exponentials [exponential], per unit time.
        pair_decay, pair_frequency: g and w of the pairs [pair], per unit time.
        damping: d [receiver], per unit time.
    """

    kind = "memory"

    def __init__(
        self,
        rates: Tensor,
        basis: Tensor,
        amplitudes: Tensor,
        decay: Tensor,
        pair_decay: Tensor,
        pair_frequency: Tensor,
        damping: Tensor | None = None,
    ) -> None:
        super().__init__()
        rates = checks.real_tensor("rates", rates)
        basis = checked_basis(basis, rates)
        amplitudes = checks.real_tensor("amplitudes", amplitudes).to(rates)
        decay, pair_decay, pair_frequency = (
            checks.real_tensor(name, value).to(rates)
            for name, value in (("decay", decay), ("pair_decay", pair_decay), ("pair_frequency", pair_frequency))
        )
        for name, value in (("decay", decay), ("pair_decay", pair_decay), ("pair_frequency", pair_frequency)):
            if value.ndim != 1:
                raise checks.fail(name, "be one-dimensional", f"shape {tuple(value.shape)}")
        for name, value in (("decay", decay), ("pair_decay", pair_decay)):
            checks.first_bad(name, "not be negative", value, value < 0, "function")
        shape = (len(decay) + 2 * len(pair_decay), *rates.shape)
        if tuple(amplitudes.shape) != shape or pair_frequency.shape != pair_decay.shape:
            raise checks.fail("amplitudes", f"have shape {shape}", f"shape {tuple(amplitudes.shape)}")
        start = basis + amplitudes[self._starts_at_one(len(decay), len(pair_decay))].sum(0)
        identity = torch.eye(len(rates), dtype=start.dtype)
        checks.first_bad(
            "amplitudes", "add up to 1 - basis at time 0", start, (start - identity).abs() > 1e-6 * (1 + amplitudes.abs().max()), "receiver"
        )  # fmt: skip
        self.register_buffer("_rates", rates.detach().clone())
        for name, value in (
            ("basis", basis), ("amplitudes", amplitudes), ("decay", decay), ("pair_decay", pair_decay),
            ("pair_frequency", pair_frequency), ("damping", checked_damping(damping, rates)),
        ):  # fmt: skip
            self.register_buffer(name, value.detach().clone())
        self._rates: Tensor
        self.amplitudes: Tensor
        self.decay: Tensor
        self.pair_decay: Tensor
        self.pair_frequency: Tensor

    @staticmethod
    def _starts_at_one(exponentials: int, pairs: int) -> list[int]:
        return [*range(exponentials), *range(exponentials, exponentials + 2 * pairs, 2)]

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def n_parameters(self) -> int:
        return self.basis.numel() + self.amplitudes[1:].numel() + len(self.decay) + 2 * len(self.pair_decay)

    @property
    def conservation_defect(self) -> float:
        """Largest share of energy that a source gains or loses at any time: the row sums of Pi - I and of all A_m."""
        leak = (self.basis.sum(-1) - 1).abs() + self.amplitudes.sum(-1).abs().sum(0)
        return float(leak.max())

    def tensors(self) -> dict[str, Tensor]:
        names = ("basis", "amplitudes", "decay", "pair_decay", "pair_frequency", "damping")
        return {"rates": self.rates, **{name: getattr(self, name) for name in names}}

    def functions(self, times: Tensor) -> Tensor:
        """f_m at each time, (time, function)."""
        t = times[:, None]
        envelope, angle = torch.exp(-self.pair_decay * t), self.pair_frequency * t
        pairs = torch.stack([envelope * angle.cos(), envelope * angle.sin()], dim=-1).flatten(1)
        return torch.cat([torch.exp(-self.decay * t), pairs], dim=1)

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        parts = torch.einsum("...s,msr->...mr", initial, self.amplitudes)
        energy = (initial @ self.basis)[..., None, :] + self.functions(times) @ parts
        return energy * torch.exp(-times[:, None] * self.damping) if bool(self.damping.any()) else energy

    def embedding(self) -> Embedding:
        """One copy of the bands for Pi and one for every function; a pair rotates into itself."""
        n = self.n_bands
        eye = torch.eye(n, dtype=self.basis.dtype, device=self.basis.device)
        zero = torch.zeros_like(eye)
        drain = torch.diag(self.damping)
        blocks = [-drain, *(-g * eye - drain for g in self.decay)]
        readout = [eye, *(eye for _ in self.decay)]
        for g, w in zip(self.pair_decay, self.pair_frequency, strict=True):
            turn = torch.stack([torch.stack([-g, -w]), torch.stack([w, -g])])
            blocks.append(torch.kron(turn, eye) - torch.block_diag(drain, drain))
            readout += [eye, zero]
        return Embedding(
            torch.cat([self.basis, *self.amplitudes], dim=1), torch.block_diag(*blocks), torch.cat(readout)
        )


def checked_order(order: Any, n_times: int) -> tuple[int, int]:
    """Numbers of exponentials and of pairs, no more functions than half the times can tell apart."""
    if not isinstance(order, (tuple, list)) or len(order) != 2:
        raise checks.FieldTypeError(f"order must be two integers, got {checks.shown(order)}")
    single, pairs = checks.integer("order", order[0], 1, 16), checks.integer("order", order[1], 0, 16)
    if 2 * (single + 2 * pairs) > n_times:
        raise checks.fail("order", f"have at most {n_times // 2} functions for {n_times} times", (single, pairs))
    return single, pairs


@dataclass(frozen=True, eq=False)
class _Problem:
    """Residual energy D(t) = T(t) - Pi as (time, entry), and its value I - Pi at time 0 as (entry,)."""

    times: np.ndarray
    data: np.ndarray
    at_zero: np.ndarray

    def functions(self, p: np.ndarray, order: tuple[int, int]) -> np.ndarray:
        g, w = np.exp(p[: sum(order)]), np.exp(p[sum(order) :])
        columns = [np.exp(-rate * self.times) for rate in g[: order[0]]]
        for rate, frequency in zip(g[order[0] :], w, strict=True):
            envelope = np.exp(-rate * self.times)
            columns += [envelope * np.cos(frequency * self.times), envelope * np.sin(frequency * self.times)]
        return np.stack(columns, axis=1)

    def amplitudes(self, functions: np.ndarray, order: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Best amplitudes under the constraint at time 0, the misfit, and an orthonormal basis of what is free."""
        start = np.concatenate([np.ones(order[0]), np.tile([1.0, 0.0], order[1])])
        free = functions[:, 1:] - functions[:, :1] * start[1:]  # the first function takes up the constraint
        rest = self.data - functions[:, :1] * self.at_zero
        if free.shape[1] == 0:
            return self.at_zero[None], rest, free
        left, scale, right = np.linalg.svd(free, full_matrices=False)
        held = scale > 1e-6 * scale[0]
        left = left[:, held]
        part = left.T @ rest
        best = (right[held].T / scale[held]) @ part
        return np.vstack([self.at_zero - start[1:] @ best, best]), rest - left @ part, left

    def jacobian(self, p: np.ndarray, order: tuple[int, int]) -> np.ndarray:
        """Derivative of the misfit to the logarithms of rates and frequencies (Kaufman 1975), (misfit, parameter)."""
        functions = self.functions(p, order)
        amplitudes, _, left = self.amplitudes(functions, order)
        t, (single, pairs) = self.times[:, None], order
        g, w = np.exp(p[: single + pairs]), np.exp(p[single + pairs :])
        slopes = [-g[i] * t * functions[:, i, None] * amplitudes[i] for i in range(single)]
        turns = []
        for j in range(pairs):
            c, s = single + 2 * j, single + 2 * j + 1
            cosine, sine = functions[:, c, None], functions[:, s, None]
            slopes.append(-g[single + j] * t * (cosine * amplitudes[c] + sine * amplitudes[s]))
            turns.append(w[j] * t * (cosine * amplitudes[s] - sine * amplitudes[c]))
        columns = [slope - left @ (left.T @ slope) for slope in (*slopes, *turns)]
        return -np.stack([column.ravel() for column in columns], axis=1)


def fit_memory(
    times: Tensor,
    mean: Tensor,
    basis: Tensor,
    order: tuple[int, int],
    starts: int = 6,
    progress: Callable[[int], Any] | None = None,
    near: MemoryModel | None = None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Least squares over all times: amplitudes by linear algebra, the few rates by Levenberg-Marquardt (variable projection).

    Golub and Pereyra (1973) with Kaufman's simplification. Energy is conserved exactly, because the amplitudes are
    linear in data whose rows sum to the same at every time. The rates are fitted on the leading singular vectors of
    the data, from several starts; deterministic.

    Args:
        times: (time,).
        mean: T [source, time, receiver].
        basis: Pi [source, receiver].
        order: number of exponentials (at least 1) and of pairs.
        starts: starts of the search.
        progress: called with 1 after every start.
        near: a model of the same order of similar data: the search starts at its rates, and nowhere else.

    Returns:
        Tensors for :class:`MemoryModel` but the rates, and a report: converged, root mean square misfit.
    """
    single, pairs = order = checked_order(order, len(times))
    n = len(basis)
    data = (mean - basis[:, None]).transpose(0, 1).reshape(len(times), -1).numpy()
    at_zero = (torch.eye(n, dtype=basis.dtype) - basis).flatten().numpy()
    full = _Problem(times.numpy(), data, at_zero)
    left, scale, right = np.linalg.svd(data, full_matrices=False)
    kept = min(24, len(scale))
    small = _Problem(times.numpy(), left[:, :kept] * scale[:kept], right[:kept] @ at_zero)
    end = float(times[-1])
    generator = np.random.Generator(np.random.Philox(key=np.array([single, pairs], dtype=np.uint64)))
    lower = np.log(np.concatenate([np.full(single + pairs, SLOWEST), np.full(pairs, 1e-2)]))
    best: Any = None
    for _ in range(starts if near is None else 1):
        g = np.exp(generator.uniform(np.log(max(SLOWEST * 2, 1 / end)), np.log(1.5), single + pairs))
        w = np.exp(generator.uniform(np.log(0.03), np.log(1.0), pairs))
        if near is not None:
            inner = np.log([SLOWEST * 1.01, FASTEST / 1.01])
            g = np.exp(np.clip(torch.cat([near.decay, near.pair_decay]).log().numpy(), *inner))
            w = np.exp(np.clip(near.pair_frequency.log().numpy(), np.log(1.01e-2), inner[1]))
        found = optimize.least_squares(
            lambda p: small.amplitudes(small.functions(p, order), order)[1].ravel(),
            np.log(np.concatenate([g, w])),
            jac=lambda p: small.jacobian(p, order),
            bounds=(lower, np.log(FASTEST)),
            ftol=1e-6,
            xtol=1e-6,
            gtol=1e-12,
            max_nfev=150,
        )
        if best is None or found.cost < best.cost:
            best = found
        if progress is not None:
            progress(1)
    amplitudes, misfit, _ = full.amplitudes(full.functions(best.x, order), order)
    amplitudes = amplitudes.reshape(-1, n, n)
    if (
        float((mean.sum(-1) - basis.sum(-1)[:, None]).abs().max()) < 1e-9
    ):  # rounding in the data, times large amplitudes
        amplitudes = amplitudes - amplitudes.mean(-1, keepdims=True)
    g, w = np.exp(best.x[: single + pairs]), np.exp(best.x[single + pairs :])
    tensors = {
        "basis": basis,
        "amplitudes": torch.from_numpy(amplitudes),
        "decay": torch.from_numpy(g[:single].copy()),
        "pair_decay": torch.from_numpy(g[single:].copy()),
        "pair_frequency": torch.from_numpy(w.copy()),
    }
    return tensors, {
        "converged": bool(best.success),
        "misfit": float(np.sqrt(np.mean(misfit**2))),
        "order": list(order),
    }
