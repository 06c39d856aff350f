"""Rate models: how the energy of each band flows to the others, from the paper's (Q, Psi) upward (Eqs. 47-51)."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchchain import checks
from torchchain.master import sample as samples
from torchchain.master.adam import AdamReport, AdamSettings, fit_rates
from torchchain.master.fits import (
    AnalyticReport,
    FitWarning,
    NonlinearReport,
    analytic_prefactor,
    linear_delay,
    linear_rates,
    nonlinear_rates,
    profile,
)
from torchchain.master.model import (
    Embedding,
    TransferModel,
    checked_basis,
    checked_damping,
    checked_square,
    flows,
    swing_in_generator,
)
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.sample import Sample
from torchchain.threads import single_thread


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

    Example:
        >>> rates = torch.tensor([[-0.2, 0.2], [0.2, -0.2]], dtype=torch.float64)
        >>> model = tc.RateModel(rates, basis=torch.tensor([0.5, 0.0], dtype=torch.float64))
        >>> late = model.transfer(torch.tensor([1000.0], dtype=torch.float64))
        >>> late[0, 0].round(decimals=3).tolist()  # half stays in band 1, the rest is shared
        [0.75, 0.25]
    """

    kind: ClassVar[str] = "markov"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {
        "rates": ("band", "band"), "basis": ("band", "band"), "damping": ("band",),
    }  # fmt: skip
    rates_meaning: ClassVar[str] = "Q of Eq. 48, which the prediction uses: per free energy of the source"

    def __init__(self, rates: Tensor, basis: Tensor, damping: Tensor | None = None) -> None:
        super().__init__()
        rates = checked_square(rates)
        self._rates = nn.Parameter(rates.detach().clone())
        self._hold(basis=checked_basis(basis, rates), damping=checked_damping(damping, rates))

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

    def _moving(self) -> Tensor:
        """The flow of the energy that moves, in one state of each band or more, without damping."""
        return self.rates

    def embedding(self) -> Embedding:
        """Free energy in its states and basis energy side by side: (I - Pi, Pi) decaying by Q - D and -D."""
        eye = torch.eye(self.n_bands, dtype=self.rates.dtype, device=self.rates.device)
        drain, moving = torch.diag(self.damping), self._moving()
        states = len(moving) // len(eye)
        return Embedding(
            torch.cat([eye - self.basis, *[torch.zeros_like(eye)] * (states - 1), self.basis], dim=1),
            torch.block_diag(moving - torch.block_diag(*[drain] * states), -drain),
            torch.cat([eye] * (states + 1)),
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

    Example:
        >>> rates = torch.tensor([[-0.2, 0.2], [0.2, -0.2]], dtype=torch.float64)
        >>> model = tc.SwingInModel(rates, torch.zeros(2, dtype=torch.float64), delay=torch.tensor(2.0, dtype=torch.float64))
        >>> model.transfer(torch.tensor([1.0], dtype=torch.float64))[0, 0, 1].item() < 0.1  # without delay 0.16
        True
    """

    kind: ClassVar[str] = "swing_in"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {**RateModel.axes, "delay": ("band",)}
    delay: Tensor

    def __init__(self, rates: Tensor, basis: Tensor, delay: Tensor, damping: Tensor | None = None) -> None:
        super().__init__(rates, basis, damping)
        delay = checks.real_tensor("delay", delay).to(self.rates)
        if delay.ndim > 1 or delay.numel() not in (1, self.n_bands):
            raise checks.fail("delay", f"be a number or have shape ({self.n_bands},)", delay)
        checks.first_bad("delay", "be positive", delay, delay <= 0, "band")
        self._hold(delay=delay.reshape(-1).expand(self.n_bands).contiguous())

    @property
    def n_parameters(self) -> int:
        return super().n_parameters + len(self.delay.unique())

    def _moving(self) -> Tensor:
        return swing_in_generator(self.rates, self.delay)

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        return TransferModel.propagate(self, initial, times)


Found = tuple[Tensor, Tensor | None, Any]
"""Q [source, receiver], tau where the model swings in, and the record of the fit."""


def _fitting(
    find: Callable[[Sample, Tensor, Tensor, Tensor, Tensor | None, Recipe, TransferModel | None, Progress], Found],
) -> Callable[[Sample, Recipe, TransferModel | None, Progress], Fitted]:
    """A fit of rates as a fit of their model.

    Where the chains lose energy, Q comes from the distribution over bands and the damping d of Eq. 51 from the loss.
    ``find`` is given the sample, Pi, the free share 1 - Pi[s, s] of each source, Q of procedure L, tau, and the rest.
    """

    def run(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
        model = recipe.model
        assert model is not None and model.basis is not None, "a rate model states what stays"  # noqa: PT018
        damping = samples.loss_rates(sample) if sample.damped else None
        sample = sample.distribution()
        basis = model.basis(sample)
        free = (1 - basis.diagonal()).clamp(min=torch.finfo(basis.dtype).eps)
        linear = linear_rates(sample.times, sample.mean, free, recipe.window)
        swings = issubclass(model.kind, SwingInModel)
        delay = linear_delay(sample.times, sample.mean, recipe.window) if swings else None
        rates, delay, report = find(sample, basis, free, linear, delay, recipe, near, progress)
        if delay is not None:
            return SwingInModel(rates, basis, delay, damping), report
        return RateModel(rates, basis, damping), report

    return run


def _linear(sample: Sample, basis: Tensor, free: Tensor, linear: Tensor, delay: Tensor | None, *_: Any) -> Found:
    return linear, delay, None


def _analytic(sample: Sample, basis: Tensor, free: Tensor, linear: Tensor, delay: Tensor | None, *_: Any) -> Found:
    q0, error = analytic_prefactor(linear)
    return q0 * profile(sample.n_bands), delay, AnalyticReport(q0, error)


def _nonlinear(
    sample: Sample, basis: Tensor, free: Tensor, linear: Tensor, delay: Tensor | None, recipe: Recipe,
    near: TransferModel | None, progress: Progress,
) -> Found:  # fmt: skip
    rates, converged, _ = nonlinear_rates(sample.times, sample.mean, free, recipe.window, progress)
    failed = [(s + 1, r + 1) for s, r in converged.logical_not().nonzero().tolist()]
    if failed:
        warnings.warn(
            f"nonlinear fit did not converge for {len(failed)} of {converged.numel()} pairs of bands, which take the "
            f"linear procedure's rate (calibration.report.fit names them)",
            FitWarning,
            stacklevel=5,
        )
    return torch.where(converged, rates, linear), delay, NonlinearReport(tuple(failed))


def _adam(
    sample: Sample, basis: Tensor, free: Tensor, linear: Tensor, delay: Tensor | None, recipe: Recipe,
    near: TransferModel | None, progress: Progress,
) -> Found:  # fmt: skip
    start, settings = linear if near is None else near.rates.detach(), recipe.settings
    with single_thread():
        rates, delay, report = fit_rates(sample.times, sample.mean, basis, start, settings, progress, delay)
    if not report.converged:
        warnings.warn(
            f"Adam did not converge in {settings.steps} steps to tolerance {settings.tolerance:g}; loss {report.loss:.3e}",
            FitWarning,
            stacklevel=5,
        )
    return rates, delay, report


FITS = (
    Fit("analytic", "Eq. 50, its one number q0 fitted to the rates of procedure L", _fitting(_analytic), report=AnalyticReport),
    Fit("linear", "procedure L of Section 3.5: straight lines at short times", _fitting(_linear)),
    Fit("nonlinear", "procedure NL: saturating exponentials at short times", _fitting(_nonlinear),
        report=NonlinearReport, window=(0.5, 4.5), least_times=4, quick=False),
    Fit("adam", "gradient descent on all times, from procedure L", _fitting(_adam),
        settings=AdamSettings, report=AdamReport, quick=False),
)  # fmt: skip


def _record(
    name: str, summary: str, basis: Callable[[Sample], Tensor], extra: Callable[[int], int], **needs: Any
) -> ReducedModel:
    """The record of a model with rates, which has ``extra(n_bands)`` numbers beside Q."""
    return ReducedModel(
        name, summary, **{"kind": RateModel, **needs}, fits=FITS, usual="adam", climbed_by="linear", basis=basis,
        size=lambda n_bands, damped, settings: n_bands**2 + extra(n_bands),
    )  # fmt: skip


PAPER = _record(
    "paper", "rates Q, basis energy Psi of Eq. 47", samples.paper_basis, lambda n: 0, needs_strength=True, default=True
)
EXACT_PSI = _record(
    "exact_psi", "Psi from the exact long-time average", samples.exact_psi, lambda n: n, needs_long_time=True
)
BASIS_MATRIX = _record(
    "basis_matrix", "basis energy of every pair of bands, Pi[s, r]", samples.exact_basis, lambda n: n**2,
    needs_long_time=True, default=True,
)  # fmt: skip
SWING_IN = _record(
    "swing_in", "rates that act some time after the energy came", samples.exact_basis, lambda n: n**2 + 1,
    kind=SwingInModel, needs_long_time=True,
)  # fmt: skip
