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


def flows(start: Tensor, generator: Tensor, times: Tensor) -> Tensor:
    """start exp(generator t) at each time, (*batch, time, state), from start (*batch, state).

    On a regular grid one matrix exponential, its squares, and products that double the number of times each;
    else one exponential per time.
    """
    latest = LONGEST_FLOW / max(float(generator.detach().abs().sum(-1).max()), 1e-300)
    if float(times[-1]) > latest:
        raise checks.fail("times", f"be at most {latest:.3g}, where rounding blurs these rates", float(times[-1]))
    count = len(times)
    step = (times[-1] - times[0]) / max(1, count - 1)
    regular = times[0] + step * torch.arange(count, dtype=times.dtype, device=times.device)
    if count < 3 or bool((times - regular).abs().max() > 1e-12 * times[-1]):
        return torch.einsum("...s,tsr->...tr", start, torch.linalg.matrix_exp(generator * times[:, None, None]))
    if float(times[0]) > 0:
        start = start @ torch.linalg.matrix_exp(generator * times[0])
    path, power = start[..., None, :], torch.linalg.matrix_exp(generator * step)
    while path.shape[-2] < count:
        path = torch.cat([path, path[..., : count - path.shape[-2], :] @ power], dim=-2)
        power = power @ power
    return path
