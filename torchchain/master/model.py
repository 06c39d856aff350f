"""Rate models: how the energy of each band flows to the others, from the paper's (Q, Psi) upward (Eqs. 47-51)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchchain import checks

LONGEST_FLOW = 1e9
"""Largest rate times time for the matrix exponential, whose rounding grows with it: 1e-7 or so there, all digits at 1e16."""


@dataclass(frozen=True, eq=False)
class Embedding:
    """A model as a linear differential equation: y(0) = e(0) start, dy/dt = y generator, e = y readout.

    Attributes:
        start: (band, state).
        generator: (state, state).
        readout: (state, band).
    """

    start: Tensor
    generator: Tensor
    readout: Tensor


class TransferModel(nn.Module):
    """What every model of the transfer between bands offers; energies are row vectors, e(t) = e(0) T(t)."""

    kind: str
    basis: Tensor
    damping: Tensor

    @property
    def rates(self) -> Tensor:
        """Q [source, receiver], per unit time."""
        raise NotImplementedError

    @property
    def n_bands(self) -> int:
        return len(self.basis)

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        raise NotImplementedError

    @property
    def conservation_defect(self) -> float:
        """How far the model, without its damping, is from conserving energy; 0 where it does."""
        raise NotImplementedError

    def tensors(self) -> dict[str, Tensor]:
        """Everything that makes the model, as its constructor takes it."""
        raise NotImplementedError

    def embedding(self) -> Embedding:
        """The model as a linear differential equation with constant coefficients."""
        raise NotImplementedError

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        """e(t) by the matrix exponential, (*batch, time, band), from initial (*batch, band)."""
        raise NotImplementedError

    def transfer(self, times: Tensor) -> Tensor:
        """T(t), (source, time, receiver): the propagation of a unit energy in each band."""
        return self.propagate(torch.eye(self.n_bands, dtype=self.basis.dtype, device=self.basis.device), times)


def checked_basis(basis: Tensor, rates: Tensor) -> Tensor:
    """Pi [source, receiver] from itself or its diagonal, checked against the rates."""
    if rates.ndim != 2 or rates.shape[0] != rates.shape[1] or not rates.numel():
        raise checks.fail("rates", "be a square matrix", f"shape {tuple(rates.shape)}")
    n = len(rates)
    basis = checks.real_tensor("basis", basis)
    basis = torch.diag(basis) if basis.ndim == 1 else basis
    if tuple(basis.shape) != (n, n):
        raise checks.fail("basis", f"have shape {(n, n)} like the rates", f"shape {tuple(basis.shape)}")
    total = basis.sum(-1)
    checks.first_bad("basis", "have row sums of at most 1", total, total > 1 + 1e-6, "band")
    return basis.to(rates)


def checked_damping(damping: Tensor | None, rates: Tensor) -> Tensor:
    """d [band], zero if None, checked against the rates."""
    damping = torch.zeros_like(rates[0]) if damping is None else checks.real_tensor("damping", damping)
    if tuple(damping.shape) != (len(rates),):
        raise checks.fail("damping", f"have shape {(len(rates),)} like the rates", f"shape {tuple(damping.shape)}")
    checks.first_bad("damping", "not be negative", damping, damping < 0, "band")
    return damping.to(rates)


class RateModel(TransferModel):
    """Transfer T(t) = Pi e^(-D t) + (I - Pi) exp((Q - D) t) between bands: e(t) = e(0) T(t), row vectors.

    Of the energy that starts in band s the share Pi[s, r] stays in band r for good (the basis energy e0 of Eq. 48);
    the rest moves with the rates Q and is conserved where the rows of Q sum to zero; D = diag(d) drains both (Eq. 51).
    The paper's model has Pi = diag(Psi) (Eq. 47).

    Args:
        rates: Q [source, receiver], per unit time.
        basis: Pi [source, receiver], or its diagonal [band].
        damping: d [band], per unit time; None for no dissipation.

    Raises:
        FieldError: for a shape that does not fit, a value that is not finite, a basis row with a sum above 1.
    """

    kind = "markov"

    def __init__(self, rates: Tensor, basis: Tensor, damping: Tensor | None = None) -> None:
        super().__init__()
        rates = checks.real_tensor("rates", rates)
        basis = checked_basis(basis, rates)
        self._rates = nn.Parameter(rates.detach().clone())
        self.register_buffer("basis", basis.detach().clone())
        self.register_buffer("damping", checked_damping(damping, rates).detach().clone())

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def n_parameters(self) -> int:
        """All of Q, and the basis where it is a matrix of its own."""
        diagonal = torch.diag(self.basis.diagonal())
        return self.n_bands**2 + (0 if torch.equal(diagonal, self.basis) else self.n_bands**2)

    @property
    def conservation_defect(self) -> float:
        """Largest row sum of Q, per unit time."""
        return float(self.rates.detach().sum(-1).abs().max())

    def tensors(self) -> dict[str, Tensor]:
        return {"rates": self.rates, "basis": self.basis, "damping": self.damping}

    def embedding(self) -> Embedding:
        """Free energy and basis energy side by side: (I - Pi, Pi) decaying by Q - D and -D."""
        eye = torch.eye(self.n_bands, dtype=self.rates.dtype, device=self.rates.device)
        drain = torch.diag(self.damping)
        return Embedding(
            torch.cat([eye - self.basis, self.basis], dim=1),
            torch.block_diag(self.rates - drain, -drain),
            torch.cat([eye, eye]),
        )

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        resting = (initial @ self.basis)[..., None, :]
        if bool(self.damping.any()):
            resting = resting * torch.exp(-times[:, None] * self.damping)
        flow = self.rates - torch.diag(self.damping)
        return resting + flows(initial - initial @ self.basis, flow, times)


class SwingInModel(RateModel):
    """A :class:`RateModel` whose rates act on energy only some time after it came: the swing-in of Section 3.5.

    Energy starts at rest, is released with the rate 1 / tau, and moves with the rates Q from then on: transfer begins
    with t^2 rather than t, and late energies are those of a :class:`RateModel` a time tau earlier, which is the t0 of
    the linear procedure. A chain of two states per band is still Markovian, conserves energy where Q does, and is
    never negative where no rate between bands is. (In a generalized master equation, whose kernel here is not a
    delta function; Nakajima 1958, Zwanzig 1960.)

    Args:
        rates, basis, damping: see :class:`RateModel`.
        delay: tau, the mean time at rest, per source or one for all.
    """

    kind = "swing_in"

    def __init__(self, rates: Tensor, basis: Tensor, delay: Tensor, damping: Tensor | None = None) -> None:
        super().__init__(rates, basis, damping)
        delay = checks.real_tensor("delay", delay).to(self.rates)
        if delay.ndim > 1 or delay.numel() not in (1, self.n_bands):
            raise checks.fail("delay", f"be a number or have shape ({self.n_bands},)", f"shape {tuple(delay.shape)}")
        checks.first_bad("delay", "be positive", delay, delay <= 0, "band")
        self.register_buffer("delay", delay.detach().clone().reshape(-1).expand(self.n_bands).contiguous())
        self.delay: Tensor

    @property
    def n_parameters(self) -> int:
        return super().n_parameters + len(self.delay.unique())

    def tensors(self) -> dict[str, Tensor]:
        return {**super().tensors(), "delay": self.delay}

    def embedding(self) -> Embedding:
        """Resting, moving and basis energy side by side."""
        eye = torch.eye(self.n_bands, dtype=self.rates.dtype, device=self.rates.device)
        drain = torch.diag(self.damping)
        return Embedding(
            torch.cat([eye - self.basis, torch.zeros_like(eye), self.basis], dim=1),
            torch.block_diag(swing_in_generator(self.rates, self.delay) - torch.block_diag(drain, drain), -drain),
            torch.cat([eye, eye, eye]),
        )

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        return propagate_embedded(self.embedding(), initial, times)


def swing_in_generator(rates: Tensor, delay: Tensor) -> Tensor:
    """Resting energy is released into moving energy, which moves with the rates, (2 band, 2 band)."""
    release = torch.diag((1 / delay).expand(len(rates)))
    return torch.cat([torch.cat([-release, release], dim=1), torch.cat([torch.zeros_like(rates), rates], dim=1)], dim=0)


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

    The times are cut into stretches of equal steps. In each, one matrix exponential, its squares, and products that
    double the number of times each.

    Raises:
        FieldError: for a time at which rounding has blurred the rates.
    """
    latest = LONGEST_FLOW / max(float(generator.detach().abs().sum(-1).max()), 1e-300)
    if float(times[-1]) > latest:
        raise checks.fail("times", f"be at most {latest:.3g}, where rounding blurs these rates", float(times[-1]))
    if float(times[0]) > 0:
        start = start @ torch.linalg.matrix_exp(generator * times[0])
    paths = [start[..., None, :]]
    for step, count in equal_steps(times):
        path, power = paths[-1][..., -1:, :], torch.linalg.matrix_exp(generator * step)
        while path.shape[-2] <= count:
            path = torch.cat([path, path[..., : count + 1 - path.shape[-2], :] @ power], dim=-2)
            power = power @ power
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
