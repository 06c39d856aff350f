"""The reduced model with memory: a few decay rates shared by all pairs of bands."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.fits import linear_weights
from torchchain.master.model import Embedding, TransferModel, checked_basis, checked_damping, checked_square
from torchchain.master.projection import Order, Poles, Projection, search
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.sample import Sample, block_weights, exact_basis, leading_vectors
from torchchain.threads import single_blas_thread

ORDERS = ((1, 0), (1, 1), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4), (3, 5), (3, 6), (4, 6), (5, 8))
"""Numbers of exponentials and of pairs that selection tries one after the other."""


class MemoryModel(TransferModel):
    """T(t) = (Pi + sum_m A_m f_m(t)) exp(-d t), with sum_m A_m f_m(0) = I - Pi.

    The f_m are exp(-g t), or the pair exp(-g t) cos(w t), exp(-g t) sin(w t), the same for all pairs of bands. In
    the field's words a generalized master equation (Nakajima 1958, Zwanzig 1960): the rate at which a band loses
    energy depends on how long ago the energy came. It is Markovian again in an enlarged state of one copy of the bands
    for Pi and one for every f_m, in which it solves like any rate equation, from any start.

    Args:
        rates: slopes of the ensemble's energies at short times [source, receiver], see ``rates_meaning``; the prediction
            does not use them.
        basis: Pi [source, receiver].
        amplitudes: A_m [function, source, receiver], the exponentials first, then cosine and sine of every pair.
        decay: g of the exponentials [exponential], per unit time.
        pair_decay, pair_frequency: g and w of the pairs [pair], per unit time.
        damping: d [receiver], per unit time.

    Example:
        >>> one = torch.eye(2, dtype=torch.float64)
        >>> half = torch.full((2, 2), 0.5, dtype=torch.float64)
        >>> none = torch.zeros(0, dtype=torch.float64)
        >>> model = tc.MemoryModel(rates=0.1 * (half - one), basis=half, amplitudes=(one - half)[None],
        ...                        decay=torch.tensor([0.1], dtype=torch.float64), pair_decay=none, pair_frequency=none)
        >>> model.transfer(torch.tensor([0.0, 1000.0], dtype=torch.float64))[0].round(decimals=3).tolist()
        [[1.0, 0.0], [0.5, 0.5]]
    """

    kind: ClassVar[str] = "memory"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {
        "rates": ("band", "band"), "basis": ("band", "band"), "damping": ("band",),
        "amplitudes": ("function", "band", "band"), "decay": ("function",),
        "pair_decay": ("function",), "pair_frequency": ("function",),
    }  # fmt: skip
    rates_meaning: ClassVar[str] = (
        "mean slopes of the energies in the calibration's window, which the prediction does not use; "
        "not the paper's Q, which is torchchain.paper_rates(transfer)"
    )
    amplitudes: Tensor
    decay: Tensor
    pair_decay: Tensor
    pair_frequency: Tensor
    _rates: Tensor

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
        rates = checked_square(rates)
        basis = checked_basis(basis, rates)
        amplitudes = checks.real_tensor("amplitudes", amplitudes).to(rates)
        poles = {"decay": decay, "pair_decay": pair_decay, "pair_frequency": pair_frequency}
        for name, value in poles.items():
            poles[name] = value = checks.real_tensor(name, value).to(rates)
            if value.ndim != 1:
                raise checks.fail(name, "be one-dimensional", value)
            if name != "pair_frequency":
                checks.first_bad(name, "not be negative", value, value < 0, "function")
        single, pairs = len(poles["decay"]), len(poles["pair_decay"])
        checks.shaped("pair_frequency", poles["pair_frequency"], (pairs,), " for pair_decay")
        checks.shaped("amplitudes", amplitudes, (single + 2 * pairs, *rates.shape), " for decay and pair_decay")
        start = basis + amplitudes[:single].sum(0) + amplitudes[single::2].sum(0)
        identity = torch.eye(len(rates), dtype=start.dtype)
        checks.first_bad(
            "amplitudes", "add up to 1 - basis at time 0", start, (start - identity).abs() > 1e-6 * (1 + amplitudes.abs().max()), "receiver"
        )  # fmt: skip
        damping = checked_damping(damping, rates)
        self._hold(_rates=rates, basis=basis, amplitudes=amplitudes, damping=damping, **poles)

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def n_parameters(self) -> int:
        kept = self.basis.numel() if bool(self.basis.any()) else 0
        return kept + self.amplitudes[1:].numel() + len(self.decay) + 2 * len(self.pair_decay)

    @property
    def order(self) -> Order:
        """Numbers of exponentials and of pairs."""
        return len(self.decay), len(self.pair_decay)

    @property
    def conservation_defect(self) -> float:
        """Largest share of energy that a source gains or loses at any time: the row sums of Pi - I and of all A_m."""
        leak = (self.basis.sum(-1) - 1).abs() + self.amplitudes.sum(-1).abs().sum(0)
        return float(leak.max())

    @property
    def words(self) -> str:
        return f"order {self.order}, {self.n_parameters} fitted numbers"

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


@dataclass(frozen=True)
class ProjectionSettings:
    """Settings of the projection.

    Attributes:
        order: None for the smallest that reaches the ensemble's own error.
        certified: whether an order that is given is fitted again, with its decay rates and some for the first collisions, so
            that no energy is negative at any time, with the proof; an order that is chosen is so in any case where possible.

    Example:
        >>> tc.master.ProjectionSettings(order=(1, 2))
        ProjectionSettings(order=(1, 2), certified=False)
    """

    order: tuple[int, int] | None = None
    certified: bool = False

    def __post_init__(self) -> None:
        checks.instance("certified", self.certified, bool)
        if self.order is None:
            return
        if not isinstance(self.order, (tuple, list)) or len(self.order) != 2:
            raise checks.FieldTypeError(f"order must be two integers, got {checks.shown(self.order)}")
        object.__setattr__(
            self,
            "order",
            (checks.integer("order", self.order[0], 1, 16), checks.integer("order", self.order[1], 0, 16)),
        )


@dataclass(frozen=True)
class ProjectionReport:
    """Whether the search for the rates ended by itself, the root mean square misfit, and the order.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40)
        >>> master = tc.calibrate(tc.band_transfer(scene, method="modes"), model="memory", order=(1, 1), bootstrap=0)
        >>> master.calibration.report.fit.order
        (1, 1)
    """

    converged: bool
    misfit: float
    order: tuple[int, int]


def checked_order(order: Any, n_times: int) -> Order:
    """Numbers of exponentials and of pairs, no more functions than half the times can tell apart."""
    single, pairs = checked = ProjectionSettings(order).order or ORDERS[0]
    if 2 * (single + 2 * pairs) > n_times:
        raise checks.fail("order", f"have at most {n_times // 2} functions for {n_times} times", (single, pairs))
    return checked


def fit_memory(
    times: Tensor, mean: Tensor, basis: Tensor, order: Order, *, near: MemoryModel | None = None,
    leading: np.ndarray | None = None, progress: Progress = None,
) -> tuple[dict[str, Tensor], ProjectionReport]:  # fmt: skip
    """Least squares over all times: amplitudes by linear algebra, the few rates by :func:`search`.

    Energy is conserved exactly, because the amplitudes are linear in data whose rows sum to the same at every time. The
    rates are searched on the leading singular vectors of the data.

    Args:
        times: (time,).
        mean: T [source, time, receiver].
        basis: Pi [source, receiver].
        order: number of exponentials (at least 1) and of pairs.
        near: a model of similar data and the same order, to start from.
        leading: right singular vectors of the data, (entry, vector), where known.
        progress: called with 1 after every step.

    Returns:
        Tensors for :class:`MemoryModel` but the rates, and a report.
    """
    order = checked_order(order, len(times))
    data = (mean - basis[:, None]).transpose(0, 1).reshape(len(times), -1).numpy()
    at_zero = (torch.eye(len(basis), dtype=basis.dtype) - basis).flatten().numpy()
    leading = leading_vectors(data) if leading is None else leading
    small = Projection(times.numpy(), data @ leading, at_zero @ leading)
    poles, ended = search(small, order, None if near is None else poles_of(near), progress)
    amplitudes, misfit, _ = Projection(times.numpy(), data, at_zero).amplitudes(poles)
    report = ProjectionReport(ended, float(np.sqrt(np.mean(misfit**2))), order)
    return packed(basis, poles, amplitudes, _conserved(mean, basis)), report


def _conserved(mean: Tensor, basis: Tensor) -> bool:
    """Whether the energies sum to what stays at every time; amplitudes sum to zero then, but for rounding."""
    return float((mean.sum(-1) - basis.sum(-1)[:, None]).abs().max()) < 1e-9


def poles_of(model: MemoryModel) -> Poles:
    """Decay rates and frequencies, in double precision."""
    every = (model.decay, model.pair_decay, model.pair_frequency)
    return Poles(*(value.detach().double().cpu().numpy() for value in every))


def packed(basis: Tensor, poles: Poles, amplitudes: np.ndarray, conserved: bool = False) -> dict[str, Tensor]:
    """Those tensors of a model that a fit finds; rows of amplitudes sum to zero where energy is conserved."""
    amplitudes = amplitudes.reshape(-1, *basis.shape)
    if conserved:
        amplitudes = amplitudes - amplitudes.mean(-1, keepdims=True)
    found = {name: torch.from_numpy(value.copy()) for name, value in vars(poles).items()}
    return {"basis": basis, "amplitudes": torch.from_numpy(amplitudes), **found}


def _stays(sample: Sample) -> Tensor:
    """Pi of the model: none of the energy of damped chains."""
    return torch.zeros_like(sample.mean[:, 0]) if sample.damped else exact_basis(sample)


def _fit(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
    if recipe.settings.certified and sample.damped:
        raise checks.fail("certified", "be False for damped chains, whose energies no certificate covers", True)
    basis, order = _stays(sample), recipe.settings.order
    rates = torch.einsum("t,str->sr", linear_weights(sample.times, recipe.window), sample.mean)
    with single_blas_thread():
        tensors, report = fit_memory(
            sample.times, sample.mean, basis, order, leading=sample.leading, progress=progress,
            near=near if isinstance(near, MemoryModel) and near.order == checked_order(order, len(sample.times)) else None,
        )  # fmt: skip
    return MemoryModel(rates=rates, **tensors), report


def replicas(transfer: BandTransfer, recipe: Recipe, model: MemoryModel, repeats: Tensor) -> Iterator[MemoryModel]:
    """Models of ensembles in which the blocks are repeated as often as told, (replica, block), fitted anew.

    A fit that starts at the model moves its rates little: it sees of the energies no more than their products with the
    model's functions f_m, with t f_m, and with the functions of the slopes and of what stays. To these few rows every
    block is reduced once, and each replica is fitted to a sum of rows.
    """
    sample, n = Sample.of(transfer), transfer.n_bands
    poles = poles_of(model)
    times = sample.times.numpy()
    wanted = np.concatenate([poles.functions(times), poles.slopes(times), np.ones((len(times), 1))], axis=1)
    rows, _ = np.linalg.qr(wanted / np.linalg.norm(wanted, axis=0))
    slope = linear_weights(sample.times, recipe.window)
    seen = torch.cat([torch.from_numpy(rows.T.copy()), slope[None]])
    every = (seen @ transfer.block_mean).flatten(1)  # [block, source * row * receiver]
    late = transfer.block_long_time
    basis = _stays(sample)
    conserved = _conserved(sample.mean, basis)
    ones, eye = rows.sum(0), np.eye(n).ravel()
    for weight in block_weights(transfer, repeats):
        kept = basis if sample.damped or late is None else torch.einsum("b,bsr->sr", weight, late)
        values = (weight @ every).unflatten(0, (n, len(seen), n))
        stays = kept.numpy().ravel()
        data = values[:, :-1].transpose(0, 1).reshape(len(ones), -1).numpy() - np.outer(ones, stays)
        small = Projection(times, data @ sample.leading, (eye - stays) @ sample.leading, rows.T)
        with single_blas_thread():
            moved, _, _ = small.polished(poles, REFIT_STEPS)
            amplitudes, _, _ = Projection(times, data, eye - stays, rows.T).amplitudes(moved)
        yield MemoryModel(rates=values[:, -1].clone(), **packed(kept, moved, amplitudes, conserved))


REFIT_STEPS = 8
"""Of the search for the rates of a replica: their spread, not their last digits, is wanted."""


def _size(n_bands: int, damped: bool, settings: ProjectionSettings) -> int:
    single, pairs = settings.order or ORDERS[0]
    functions = single + 2 * pairs
    return n_bands**2 * (functions - 1 + (not damped)) + functions


def _rungs(n_times: int) -> list[ProjectionSettings]:
    """The orders whose functions so many times can tell apart."""
    found = [ProjectionSettings(order) for order in ORDERS if 2 * (order[0] + 2 * order[1]) <= n_times]
    if not found:
        raise checks.fail("transfer", "have at least 2 times for model 'memory'", f"{n_times}")
    return found


MEMORY = ReducedModel(
    "memory", "any response, as a few decay rates shared by all pairs of bands", MemoryModel,
    (Fit("projection", "variable projection on all times", _fit, settings=ProjectionSettings, report=ProjectionReport,
         check=lambda settings, n_times: checked_order(settings.order, n_times)),),
    _size, climbed_by="projection", default=True, needs_long_time=True, fits_loss=True, rungs=_rungs, replicas=replicas,
)  # fmt: skip
