"""The calibrated master equation: prediction of band energies, and its file (Eqs. 48-51)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchchain import checks
from torchchain.master import artifact
from torchchain.master.model import TransferModel
from torchchain.master.solvers import SOLVERS, IntegrationError
from torchchain.scene import Scene
from torchchain.threads import single_thread


@dataclass(frozen=True)
class Calibration:
    """How a master equation came to be: method, model, fit window, scene and the report of the fit."""

    method: str
    model: str
    window: tuple[float, float] | None
    scene: Scene
    report: dict[str, Any] = field(default_factory=dict)


class MasterEquation(nn.Module):
    """Predicts the energy in every band at any later time, from any start over the bands.

    Row vectors: e(t) = e(0) T(t), and Q[s, r] is the rate from band s to band r. Units: share of the energy, and
    travel times of sound over one particle.

    Args:
        model: the rate model.
        calibration: where it comes from.
    """

    def __init__(self, model: TransferModel, calibration: Calibration) -> None:
        super().__init__()
        self.model = model
        self.calibration = calibration

    @property
    def rates(self) -> Tensor:
        """Q [source, receiver]; rows sum to zero where energy is conserved."""
        return self.model.rates

    @property
    def basis(self) -> Tensor:
        """Pi [source, receiver]: the share of the energy of a source that stays in a receiver for good."""
        return self.model.basis

    @property
    def damping(self) -> Tensor:
        """d [band], the dissipation rate of Eq. 51."""
        return self.model.damping

    @property
    def n_bands(self) -> int:
        return self.model.n_bands

    def solve(self, initial: Any, times: Any, method: str = "expm", **options: Any) -> Tensor:
        """Band energies at the given times.

        Args:
            initial: energy per band at time 0, (*batch, band), in any unit.
            times: (time,), increasing, not negative.
            method: a name in ``SOLVERS``: "expm" or a method of torchdiffeq.
            options: the solver's own: ``rtol`` and ``atol``, or ``step``.

        Returns:
            (*batch, time, band), in the unit of ``initial``.

        Raises:
            FieldError, FieldTypeError: for a bad argument.
            IntegrationError: if the solver fails, with its numbers.
        """
        solver = SOLVERS[checks.choice("method", method, SOLVERS)]
        checks.known_keys(f"options of solver '{method}'", options, solver.options)
        initial = checks.real_tensor("initial", initial).to(self.rates)
        if initial.ndim == 0 or initial.shape[-1] != self.n_bands:
            raise checks.fail("initial", f"have {self.n_bands} bands on its last axis", f"shape {tuple(initial.shape)}")
        times = checks.times("times", times).to(self.rates)
        with single_thread():
            energy = solver.run(self.model, initial, times, **options)
        if not bool(energy.isfinite().all()):
            raise IntegrationError(f"solver '{method}' must stay finite, got overflow up to time {float(times[-1]):g}")
        return energy

    def forward(self, initial: Tensor, times: Tensor) -> Tensor:
        """:meth:`solve` by the matrix exponential."""
        return self.solve(initial, times)

    @property
    def conservation_defect(self) -> float:
        """How far the model, without its damping, is from conserving energy; see the model's own."""
        return self.model.conservation_defect

    @property
    def most_negative_rate(self) -> float:
        """The most negative rate of Q between two bands; 0 if none is negative."""
        rates = self.rates.detach()
        return min(0.0, float((rates - torch.diag(rates.diagonal())).min()))

    def save(self, path: str | Path) -> None:
        """Write the model as safetensors, all or nothing."""
        artifact.save(self.model, self.calibration.__dict__, path)

    @classmethod
    def load(cls, path: str | Path) -> MasterEquation:
        """Read a saved model; every field is checked.

        Raises:
            FieldError: naming the file and what is wrong with it.
        """
        model, record = artifact.load(path)
        return cls(model, Calibration(**record))
