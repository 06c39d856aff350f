"""What every reduced model of the transfer between bands offers, and how a linear one is propagated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchchain import checks

LONGEST_FLOW = 1e9
"""Largest rate times time for the matrix exponential, whose rounding grows with it: 1e-7 or so there, all digits at 1e16."""
MOST_STEPS = 64
"""Matrix exponentials of different steps that are kept at once."""


@dataclass(frozen=True, eq=False)
class Embedding:
    """A model as a linear differential equation: y(0) = e(0) start, dy/dt = y generator, e = y readout.

    Attributes:
        start: (band, state).
        generator: (state, state).
        readout: (state, band).

    Example:
        >>> rates = torch.tensor([[-0.2, 0.2], [0.2, -0.2]], dtype=torch.float64)
        >>> embedding = tc.RateModel(rates, torch.zeros(2, dtype=torch.float64)).embedding()
        >>> moved = embedding.start @ torch.linalg.matrix_exp(embedding.generator * 1000.0) @ embedding.readout
        >>> moved.round(decimals=3).tolist()
        [[0.5, 0.5], [0.5, 0.5]]
    """

    start: Tensor
    generator: Tensor
    readout: Tensor


class TransferModel(nn.Module):
    """A model of the transfer T(t) between bands; energies are row vectors, e(t) = e(0) T(t).

    A kind of one's own needs ``kind``, ``axes``, the tensors named there as attributes and constructor arguments
    ("basis" [source, receiver] and "damping" [band] among them), ``n_parameters``, and :meth:`embedding`.

    Attributes:
        kind: what its files call it.
        axes: of each tensor that makes the model: "band", or any other word for an axis of any length.
        optional: those of them that a file may lack.
        rates_meaning: what :attr:`rates` are, in words.
        has_equation: whether its energies are those of :meth:`embedding`, which else is the nearest linear equation to them.
        predicts: observables of a scene that it can stand in for.

    Example:
        >>> class Settling(tc.TransferModel):  # a model of your own: every band relaxes to its share in Pi at one rate
        ...     kind, axes, n_parameters = "settling", {"basis": ("source", "receiver"), "damping": ("band",)}, 1
        ...     def __init__(self, basis, damping=None):
        ...         super().__init__()
        ...         self.basis, self.damping = basis, torch.zeros(len(basis)) if damping is None else damping
        ...     def embedding(self):
        ...         n, one = len(self.basis), torch.eye(len(self.basis), dtype=self.basis.dtype)
        ...         rate = torch.cat([torch.zeros(n), torch.full((n,), -0.1)]).to(one)
        ...         return tc.master.Embedding(torch.cat([self.basis, one - self.basis], 1), rate.diag(), torch.cat([one, one]))
        >>> model = Settling(torch.full((2, 2), 0.5, dtype=torch.float64))
        >>> model.transfer(torch.tensor([0.0, 1000.0], dtype=torch.float64))[0].round(decimals=3).tolist()
        [[1.0, 0.0], [0.5, 0.5]]
    """

    kind: ClassVar[str]
    axes: ClassVar[dict[str, tuple[str, ...]]]
    optional: ClassVar[tuple[str, ...]] = ()
    predicts: ClassVar[frozenset[str]] = frozenset({"band_energy", "long_time_band_energy"})
    rates_meaning: ClassVar[str] = "slope of the model's transfer at time 0"
    has_equation: ClassVar[bool] = True
    basis: Tensor
    damping: Tensor

    @property
    def rates(self) -> Tensor:
        """[source, receiver], per unit time; see ``rates_meaning``."""
        parts = self.embedding()
        return parts.start @ parts.generator @ parts.readout

    @property
    def n_bands(self) -> int:
        return len(self.basis)

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        raise NotImplementedError

    @property
    def conservation_defect(self) -> float:
        """How far the model, without its damping, is from conserving energy, at times of order 1 where not told better."""
        return float((self.transfer(torch.ones(1).to(self.basis)).detach().sum(-1) - 1).abs().max())

    @property
    def words(self) -> str:
        """One phrase on the size of the model."""
        return f"{self.n_parameters} fitted numbers"

    def tensors(self) -> dict[str, Tensor]:
        """Everything that makes the model, as its constructor takes it."""
        return {name: getattr(self, name) for name in self.axes}

    def _hold(self, **tensors: Tensor) -> None:
        """Make copies of tensors part of the model."""
        for name, value in tensors.items():
            self.register_buffer(name, value.detach().clone())

    def embedding(self) -> Embedding:
        """The model as a linear differential equation with constant coefficients."""
        raise NotImplementedError

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        """e(t) by the matrix exponential, (*batch, time, band), from initial (*batch, band)."""
        return propagate_embedded(self.embedding(), initial, times)

    def transfer(self, times: Tensor) -> Tensor:
        """T(t), (source, time, receiver): the propagation of a unit energy in each band."""
        return self.propagate(torch.eye(self.n_bands).to(self.basis), times)


def checked_square(rates: Tensor) -> Tensor:
    """Rates [source, receiver]."""
    rates = checks.real_tensor("rates", rates)
    if rates.ndim != 2 or rates.shape[0] != rates.shape[1] or not rates.numel():
        raise checks.fail("rates", "be a square matrix", rates)
    return rates


def checked_basis(basis: Tensor, rates: Tensor) -> Tensor:
    """Pi [source, receiver] from itself or its diagonal, checked against the rates."""
    basis = checks.real_tensor("basis", basis)
    basis = checks.shaped(
        "basis", torch.diag(basis) if basis.ndim == 1 else basis, tuple(rates.shape), " like the rates"
    )
    total = basis.sum(-1)
    checks.first_bad("basis", "have row sums of at most 1", total, total > 1 + 1e-6, "band")
    return basis.to(rates)


def checked_damping(damping: Tensor | None, rates: Tensor) -> Tensor:
    """d [band], zero if None, checked against the rates."""
    damping = torch.zeros_like(rates[0]) if damping is None else damping
    damping = checks.shaped("damping", damping, (len(rates),), " like the rates")
    checks.first_bad("damping", "not be negative", damping, damping < 0, "band")
    return damping.to(rates)


def propagate_embedded(parts: Embedding, initial: Tensor, times: Tensor, supply: Tensor | None = None) -> Tensor:
    """e(t) of an embedded model by the matrix exponential, (*batch, time, band).

    Args:
        parts: the model.
        initial: (*batch, band).
        times: (time,).
        supply: energy fed in per unit time, constant between times, (*batch, time, band): the rate up to each time from
            the one before it (from 0 for the first). With y the state and p the supply, (y, p) obeys one more
            linear equation, whose exponential is exact.
    """
    state = initial @ parts.start
    if supply is None:
        return flows(state, parts.generator, times) @ parts.readout
    size, bands = parts.generator.shape[0], initial.shape[-1]
    fed = torch.zeros(size + bands, size + bands, dtype=parts.generator.dtype, device=parts.generator.device)
    fed[:size, :size], fed[size:, :size] = parts.generator, parts.start
    outputs, before, power, length = [], 0.0, fed, -1.0
    for i, t in enumerate(times.tolist()):
        if abs(t - before - length) > 1e-12 * max(t, 1e-300):
            length = t - before
            power = torch.linalg.matrix_exp(fed * length)
        now = supply[..., i, :]
        joined = torch.cat([state.expand(*now.shape[:-1], size), now], dim=-1)
        state = (joined @ power)[..., :size]
        outputs.append(state @ parts.readout)
        before = t
    return torch.stack(outputs, dim=-2)


def flows(start: Tensor, generator: Tensor, times: Tensor) -> Tensor:
    """start exp(generator t) at each time, (*batch, time, state), from start (*batch, state).

    The times are cut into stretches of equal steps. In each, the matrix exponential of the step, where it is not at hand
    nor that of its half, its squares, and products that double the number of times each.

    Raises:
        FieldError: for a time at which rounding has blurred the rates.
    """
    latest = LONGEST_FLOW / max(float(generator.detach().abs().sum(-1).max()), 1e-300)
    if float(times[-1]) > latest:
        raise checks.fail("times", f"be at most {latest:.3g}, where rounding blurs these rates", float(times[-1]))
    exponentials: dict[str, Tensor] = {}

    def after(step: float) -> Tensor:
        name, half = f"{step:.12g}", exponentials.get(f"{step / 2:.12g}")
        if name not in exponentials:
            if len(exponentials) == MOST_STEPS:
                exponentials.clear()
            exponentials[name] = torch.linalg.matrix_exp(generator * step) if half is None else half @ half
        return exponentials[name]

    if float(times[0]) > 0:
        start = start @ after(float(times[0]))
    paths = [start[..., None, :]]
    for step, count in equal_steps(times):
        path, power = paths[-1][..., -1:, :], after(step)
        while path.shape[-2] <= count:
            path = torch.cat([path, path[..., : count + 1 - path.shape[-2], :] @ power], dim=-2)
            power = power @ power if path.shape[-2] <= count else power
        paths.append(path[..., 1:, :])
    return torch.cat(paths, dim=-2)


def equal_steps(times: Tensor) -> list[tuple[float, int]]:
    """The steps between times as stretches of equal ones: (step, how many)."""
    stretches: list[tuple[float, int]] = []
    ticks = times.tolist()
    begin = 0
    while begin < len(ticks) - 1:
        step, end = ticks[begin + 1] - ticks[begin], begin + 1
        while end + 1 < len(ticks):
            foreseen = ticks[begin] + step * (end + 1 - begin)
            if abs(foreseen - ticks[end + 1]) > 1e-12 * ticks[end + 1]:
                break
            end += 1
        stretches.append(((ticks[end] - ticks[begin]) / (end - begin), end - begin))
        begin = end
    return stretches


def swing_in_generator(rates: Tensor, delay: Tensor) -> Tensor:
    """Resting energy is released into moving energy, which moves with the rates, (2 band, 2 band)."""
    release = torch.diag((1 / delay).expand(len(rates)))
    return torch.cat([torch.cat([-release, release], dim=1), torch.cat([torch.zeros_like(rates), rates], dim=1)], dim=0)
