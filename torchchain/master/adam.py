"""Rates from whole trajectories: Adam on Q, with a conservation penalty or exact by construction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchchain import checks
from torchchain.master.model import flows, swing_in_generator

CONSTRAINTS = ("exact", "penalty")


@dataclass(frozen=True)
class AdamSettings:
    """How Adam fits the rates.

    Attributes:
        constraint: "exact": rates between bands are softplus of a parameter and the diagonal is minus the row sum, so
            that energy is conserved and no rate is negative; "penalty": all of Q is free and leakage costs.
        penalty: weight of the mean squared row sum of Q (in 1/time^2) in the loss; for "penalty" alone.
        steps: largest number of steps.
        learning_rate: of the parameters in units of their typical size.
        tolerance: stop when the loss falls by less than this fraction in 50 steps.

    Example:
        >>> tc.master.AdamSettings(steps=50).constraint
        'exact'
    """

    constraint: str = "exact"
    penalty: float = 10.0
    steps: int = 2000
    learning_rate: float = 0.3
    tolerance: float = 1e-4

    def __post_init__(self) -> None:
        checks.choice("constraint", self.constraint, CONSTRAINTS)
        object.__setattr__(self, "penalty", checks.number("penalty", self.penalty, at_least=0, at_most=1e100))
        checks.integer("steps", self.steps, 1, 10**6)
        checks.number("learning_rate", self.learning_rate, above=0, at_most=10)
        checks.number("tolerance", self.tolerance, at_least=0, below=1)


@dataclass(frozen=True)
class AdamReport:
    """How the search went: whether the loss, a mean squared misfit, settled, its first and smallest value, the constraint.

    Example:
        >>> import warnings
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=20), method="modes")
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("ignore")  # 50 steps are few
        ...     report = tc.calibrate(transfer, method="adam", steps=50).calibration.report.fit
        >>> report.steps <= 50, report.loss < report.first_loss
        (True, True)
    """

    converged: bool
    steps: int
    loss: float
    first_loss: float
    constraint: str
    penalty: float


class Rates(nn.Module):
    """Q from a parameter in units of its typical size: itself, or none negative between bands and rows that sum to zero.

    Args:
        rates: to start from, [source, receiver].
        exact: which of the two.
    """

    def __init__(self, rates: Tensor, exact: bool) -> None:
        super().__init__()
        off = rates - torch.diag(rates.diagonal())
        self.exact, self.scale = exact, off.abs().mean().clamp(min=1e-12)
        positive = (off / self.scale).clamp(min=1e-3)
        softened = positive + torch.log(-torch.expm1(-positive))  # the inverse of softplus
        self.raw = nn.Parameter(softened if exact else rates / self.scale)

    def forward(self) -> Tensor:
        if not self.exact:
            return self.raw * self.scale
        off = nn.functional.softplus(self.raw) * self.scale
        off = off - torch.diag(off.diagonal())
        return off - torch.diag(off.sum(-1))


def fit_rates(
    times: Tensor,
    mean: Tensor,
    basis: Tensor,
    initial: Tensor,
    settings: AdamSettings,
    progress: Any = None,
    delay: Tensor | None = None,
) -> tuple[Tensor, Tensor | None, AdamReport]:
    """Minimize the squared difference between Pi + (I - Pi) exp(Q t) and the ensemble over all times.

    Deterministic: it starts from ``initial`` and draws no random number.

    Args:
        times: (time,).
        mean: [source, time, receiver].
        basis: Pi [source, receiver].
        initial: Q to start from.
        settings: see :class:`AdamSettings`.
        progress: called with 1 after every step.
        delay: tau of :class:`SwingInModel` to start from, fitted too; None for rates that act at once.

    Returns:
        Q [source, receiver] and tau of the smallest loss, and a report.
    """
    rest = torch.eye(len(basis), dtype=basis.dtype) - basis
    module = Rates(initial, settings.constraint == "exact")
    groups: list[dict[str, Any]] = [{"params": list(module.parameters())}]
    if delay is not None:
        log_delay = nn.Parameter(delay.log())
        rest = torch.cat([rest, torch.zeros_like(rest)], dim=1)
        groups.append({"params": [log_delay], "lr": settings.learning_rate / 10})
    optimizer = torch.optim.Adam(groups, lr=settings.learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimizer, settings.steps, eta_min=settings.learning_rate / 50
    )
    losses: list[float] = []
    best, best_rates, best_delay = float("inf"), initial, delay
    converged = False
    for _ in range(settings.steps):
        rates = module()
        if delay is None:
            moved = flows(rest, rates, times)
        else:
            stages = flows(rest, swing_in_generator(rates, log_delay.exp()), times)
            moved = stages[..., : len(rates)] + stages[..., len(rates) :]
        misfit = (basis[:, None] + moved - mean).square().sum(-1).mean()
        leak = rates.sum(-1).square().mean()
        loss = misfit + (settings.penalty * leak if settings.constraint == "penalty" else 0.0)
        value = float(loss.detach())
        if value < best:
            best, best_rates = value, rates.detach().clone()
            best_delay = None if delay is None else log_delay.detach().exp()
        losses.append(value)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if progress is not None:
            progress(1)
        if len(losses) > 100 and min(losses[:-50]) - best < settings.tolerance * best:
            converged = True
            break
    report = AdamReport(converged, len(losses), best, losses[0], settings.constraint, settings.penalty)
    return best_rates, best_delay, report
