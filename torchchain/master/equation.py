"""The calibrated master equation: prediction of band energies, and its file (Eqs. 48-51)."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from torchchain import checks, plots
from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.energy.bands import center_tones
from torchchain.energy.start_energy import StartEnergy, excited
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_words import describe
from torchchain.master import file
from torchchain.master.coarsening import coarsen
from torchchain.master.concerns import differences
from torchchain.master.fits import AnalyticReport
from torchchain.master.model import TransferModel
from torchchain.master.report import Calibration
from torchchain.master.solving import SOLVERS, IntegrationError
from torchchain.master.starts import StartModel
from torchchain.master.uncertainty import Uncertainty
from torchchain.threads import single_thread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEGATIVE_SHARE = 1e-3
"""Negative energies of a band up to this share of the total are not worth a warning."""
GAINED_SHARE = 1e-2
"""Nor is energy that a model makes, up to this share of the total."""
WITHOUT_STARTS = "the model was calibrated without other starts: energies of bands are taken as those of its own tones, released at rest"
OF_CHAINS_TOO = "energies by site are no squares, and chains on their way to rest have such energies as well"


class PredictionWarning(UserWarning):
    """A prediction beyond what the model was compared with, or with energies that cannot be.

    Example:
        >>> import warnings
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=torch.linspace(0, 5, 21))
        >>> master = tc.calibrate(tc.band_transfer(scene, method="modes"), model="paper", method="linear")
        >>> with warnings.catch_warnings(record=True) as told:
        ...     warnings.simplefilter("always")
        ...     _ = master.solve(torch.eye(8, dtype=torch.float64), [0.0, 1e4])  # far beyond the chains
        >>> any(issubclass(warning.category, tc.PredictionWarning) for warning in told)
        True
    """


TrustWarning = PredictionWarning
"""Its earlier name."""


class MasterEquation(Printed, nn.Module):
    """Predicts the energy in every band at any later time, from any start over the bands.

    Row vectors: e(t) = e(0) T(t). Units: share of the energy, and travel times of sound over one particle.

    Args:
        model: the reduced model.
        calibration: where it comes from; None for a model of your own.
        uncertainty: standard errors by bootstrap; None if there are none.
        starts: the model of other starts than the calibrated tones at rest; None if there is none.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40, times=torch.linspace(0, 50, 51))
        >>> master = tc.calibrate(tc.band_transfer(scene, method="modes"), model="paper", method="linear")
        >>> start = torch.zeros(8, dtype=torch.float64)
        >>> start[4] = 1.0  # all in band 5
        >>> energy = master.solve(start, [0.0, 10.0, 50.0], method="expm")
        >>> tuple(energy.shape), torch.allclose(energy.sum(-1), torch.ones(3, dtype=torch.float64))
        ((3, 8), True)
    """

    def __init__(
        self, model: TransferModel, calibration: Calibration | None, uncertainty: Uncertainty | None = None,
        starts: StartModel | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        checks.instance("model", model, TransferModel)
        checks.instance("calibration", calibration, Calibration, type(None))
        checks.instance("uncertainty", uncertainty, Uncertainty, type(None))
        self.model = model
        self.calibration = calibration or Calibration("given", "given", None)
        self.uncertainty = uncertainty
        checks.instance("starts", starts, StartModel, type(None))
        if starts is not None and starts.n_bands != model.n_bands:
            raise checks.fail("starts", f"have the {model.n_bands} bands of the model", starts.n_bands)
        self.starts = starts

    @property
    def rates(self) -> Tensor:
        """[source, receiver], per unit time: of a model with rates its Q, of others what :attr:`rates_meaning` says.

        The paper's Q of any transfer, with standard errors, is :func:`torchchain.paper_rates`.
        """
        return self.model.rates

    @property
    def rates_meaning(self) -> str:
        """What :attr:`rates` are, in words."""
        return self.model.rates_meaning

    @property
    def basis(self) -> Tensor:
        """Pi [source, receiver]: the share of the energy of a source that stays in a receiver for good."""
        return self.model.basis

    @property
    def damping(self) -> Tensor:
        """d [band], the dissipation rate of Eq. 51."""
        loss = self.calibration.report.loss
        return self.model.damping if loss is None else torch.tensor(loss.rates).to(self.basis)

    @property
    def n_parameters(self) -> int:
        """Fitted numbers."""
        if isinstance(self.calibration.report.fit, AnalyticReport):
            return 1
        return self.model.n_parameters

    @property
    def horizon(self) -> float:
        """Time up to which predictions were compared with chains; infinity where these had settled, or if unknown."""
        return self.calibration.report.horizon

    @property
    def n_bands(self) -> int:
        return self.model.n_bands

    def _rows(self) -> dict[str, str]:
        rows = {"model": f"{self.model.kind}: {self.model.words}; {self.n_bands} bands"}
        record, scene = self.calibration, self.calibration.scene
        if record.method != "given":
            rows["model"] = f"{record.model}, fitted by {record.method}: {self.model.words}; {self.n_bands} bands"
            rows["calibrated on"] = (
                describe(scene) if scene is not None else record.provenance or "data without a scene"
            )
            rows["compared with chains"] = "at all times" if self.horizon == math.inf else f"up to t = {self.horizon:g}"
        if self.uncertainty is not None:
            rows["standard error"] = f"of a share of the energy at most {float(self.uncertainty.stderr.max()):.1e}"
        selection = self.calibration.report.selection
        if selection is not None and selection.held_out_distance is not None:
            rows["held-out distance"] = (
                f"{selection.held_out_distance:.4f}, of two halves {selection.halves_distance:.4f}"
            )
        if self.starts is not None:
            rows["starts"] = (
                f"any on {self.starts.n_particles} particles: {self.starts.n_parameters} fitted numbers more"
            )
        if bool(self.damping.any()):
            rows["damping"] = f"{float(self.damping.min()):.3g} to {float(self.damping.max()):.3g} per unit time"
        sure = "never negative, proved for all times; " if self.calibration.report.certificate is not None else ""
        rows["energies"] = f"{sure}conservation defect {self.conservation_defect:.1e}"
        return rows | {"rates": self.rates_meaning}

    def solve(self, initial: Any, times: Any, method: str = "expm", *, supply: Any = None, **options: Any) -> Tensor:
        """Band energies at the given times.

        Energies per band are taken as those of the calibrated tones, released at rest.

        Args:
            initial: energy per band at time 0, (*batch, band), in any unit; or a start in space, of a model with ``starts``:
                from :func:`torchchain.start_energy`, an Impulse, or a StandingWave (an axis of tones). Its energy at
                k = 0 is in no band.
            times: (time,), increasing, not negative.
            method: a name in ``SOLVERS``: "expm" or a method of torchdiffeq.
            supply: energy fed into each band per unit time, (band,) at all times, or (*batch, time, band): constant
                up to each time from the one before it, from 0 for the first.
            options: the solver's own: ``rtol`` and ``atol``, or ``step``.

        Returns:
            (*batch, time, band), in the unit of ``initial``.

        Raises:
            FieldError, FieldTypeError: for a bad argument.
            IntegrationError: if the solver fails, with its numbers.

        Warns:
            PredictionWarning: for times beyond the model's horizon, for a band with a clearly negative energy, for energy made, and
                for a model that obeys no differential equation, where one is solved or energy is supplied.

        Example:
            >>> import torch, torchchain as tc
            >>> model = tc.RateModel(torch.tensor([[-0.3, 0.3], [0.0, 0.0]]), torch.zeros(2))
            >>> tc.MasterEquation(model, None).solve([1.0, 0.0], [0.0, 1e3]).round(decimals=3).tolist()
            [[1.0, 0.0], [0.0, 1.0]]
        """
        solver = SOLVERS[checks.choice("method", method, SOLVERS)]
        checks.known_keys(f"options of solver '{method}'", options, solver.options)
        times = checks.times("times", times).to(self.rates)
        start = self._start(initial)
        if start is not None and self.starts is not None:
            checks.choice("method for a start in space", method, ("expm",))
            if supply is not None:
                raise checks.fail("supply", "be None for a start in space", checks.shown(supply))
            with single_thread():
                energy = self.starts.solve(start, times).to(self.rates)
            doubts = self._doubts(start.bands(self.n_bands).to(self.rates), times, None, energy.detach(), OF_CHAINS_TOO)
        else:
            of_bands = self._initial(initial if start is None else start.bands(self.n_bands))
            fed = None if supply is None else self._supply(supply, of_bands, times)
            with single_thread():
                energy = solver.run(self.model, of_bands, times, fed, **options)
            if not bool(energy.isfinite().all()):
                raise IntegrationError(
                    f"solver '{method}' must stay finite, got overflow up to time {float(times[-1]):g}"
                )
            doubts = [] if start is None else [WITHOUT_STARTS]
            if energy.numel() and not self.model.has_equation and (fed is not None or method != "expm"):
                words = "supply takes the nearest model with memory"
                if fed is None:
                    off = f"{self._off(of_bands, times, energy):.1e} of the energy away at these times"
                    words = f"{method!r} takes the nearest model with memory, up to {off}"
                doubts.append(f"the model '{self.model.kind}' obeys no differential equation: {words}")
            doubts += self._doubts(of_bands, times, fed, energy.detach())
        for words in doubts:
            warnings.warn(words, PredictionWarning, stacklevel=2)
        return energy

    def transfer(self, times: Any) -> Tensor:
        """T(t) [source, time, receiver]: :meth:`solve` from a unit energy in each band, with its errors and warnings."""
        return self.solve(torch.eye(self.n_bands).to(self.basis), times)

    def _off(self, initial: Tensor, times: Tensor, energy: Tensor) -> float:
        """Largest distance of energies from the model's own, of each start's total."""
        with torch.no_grad():
            off = (energy - self.model.propagate(initial, times)).abs().amax((-2, -1))
            return float((off / initial.abs().sum(-1).clamp(min=torch.finfo(off.dtype).tiny)).max())

    def _start(self, initial: Any) -> StartEnergy | None:
        """A start in space; None for energies of bands."""
        scene = self.calibration.scene
        if isinstance(initial, (Impulse, StandingWave)):
            if scene is None and self.starts is None:
                raise checks.fail("initial", "be energies of bands for a model without a scene", type(initial).__name__)
            count = self.starts.n_particles if self.starts is not None else scene.n_particles  # type: ignore[union-attr]
            if isinstance(initial, StandingWave) and initial.tones is None:
                initial = replace(initial, tones=center_tones(count, self.n_bands))
            return excited(initial, count)
        return initial if isinstance(initial, StartEnergy) else None

    def _initial(self, initial: Any) -> Tensor:
        initial = checks.real_tensor("initial", initial).to(self.rates)
        if initial.ndim == 0 or initial.shape[-1] != self.n_bands:
            raise checks.fail("initial", f"have {self.n_bands} bands on its last axis", initial)
        return initial

    def _supply(self, supply: Any, initial: Tensor, times: Tensor) -> Tensor:
        supply = checks.real_tensor("supply", supply).to(self.rates)
        shape = (len(times), self.n_bands)
        if supply.ndim == 1:
            supply = supply[None]
        if supply.ndim == 0 or supply.shape[-1] != self.n_bands or supply.shape[-2] not in (1, len(times)):
            raise checks.fail("supply", f"have shape {(self.n_bands,)} or (*batch, {shape[0]}, {shape[1]})", supply)  # fmt: skip
        try:
            batch = np.broadcast_shapes(supply.shape[:-2], initial.shape[:-1])
        except ValueError:
            raise checks.fail("supply", f"fit a batch of {tuple(initial.shape[:-1])} starts", supply) from None  # fmt: skip
        return supply.expand(*batch, *shape)

    def _doubts(
        self, initial: Tensor, times: Tensor, fed: Tensor | None, energy: Tensor,
        why_negative: str = "the model is that uncertain there",
    ) -> list[str]:  # fmt: skip
        """What to warn of in a prediction."""
        end, found = float(times[-1]), []
        if end > self.horizon * (1 + 1e-9):
            found.append(
                f"prediction to time {end:g} lies beyond {self.horizon:g}, up to which this model was compared with chains"
            )
        if not energy.numel() or bool((initial < 0).any()) or (fed is not None and bool((fed < 0).any())):
            return found
        total = initial.sum(-1)[..., None]
        if fed is not None:
            steps = torch.diff(times, prepend=times.new_zeros(1))
            total = total + (fed.sum(-1) * steps).cumsum(-1)
        total = total.clamp(min=torch.finfo(total.dtype).tiny)
        gained = energy.sum(-1) / total - 1
        if float(gained.max()) > GAINED_SHARE:
            when = float(times[int(gained.reshape(-1, len(times)).amax(0).argmax())])
            found.append(
                f"predicted energy has grown by {float(gained.max()):.2g} of the total at time {when:g}: rows of the rates "
                f"that do not sum to zero make energy (conservation_defect {self.conservation_defect:.2g})"
            )
        lowest = float((energy.amin(-1) / total).min())
        if lowest < -NEGATIVE_SHARE:
            found.append(f"lowest predicted energy of a band is {lowest:.2g} of the total: {why_negative}")
        return found

    def standard_error(self, initial: Any, times: Any) -> Tensor:
        """Standard error of :meth:`solve`, (*batch, time, band), by bootstrap and with the model's own misfit.

        Args:
            initial, times: see :meth:`solve`.

        Raises:
            FieldError: if the calibration has no error bars.
        """
        if self.uncertainty is None:
            raise checks.fail("bootstrap", "be at least 2 in calibrate() for error bars", 0)
        start = self._start(initial)
        if start is not None and self.starts is not None:
            return self.starts.standard_error(start, checks.times("times", times), self.uncertainty).to(self.rates)
        initial = initial if start is None else start.bands(self.n_bands)
        return self.uncertainty.of(self._initial(initial), checks.times("times", times).to(self.rates))

    def dissipated(self, initial: Any, times: Any) -> Tensor:
        """Energy lost to damping up to each time, (*batch, time): what :meth:`solve` leaves of the start is the rest."""
        initial = self._initial(initial)
        return initial.sum(-1)[..., None] - self.solve(initial, times).sum(-1)

    def concerns(self, scene: Scene) -> list[str]:
        """What of a scene this model was not calibrated for, in words; empty if nothing.

        All of the scene is compared that changes energies, the disorder's strength to 1e-9. The chain's length may change
        where the wave has not yet gone round: bands are those of wavenumber, and a tone belongs at its place in its band.
        Seed, realizations, tolerance and observables do not matter, nor do times and tones that were left out.
        """
        checks.instance("scene", scene, Scene)
        own = self.calibration.scene
        end, found = float(scene.times[-1]), []
        if scene.n_bands != self.n_bands:
            found.append(f"bands {scene.n_bands}, calibrated on {self.n_bands}")
        if end > self.horizon:
            found.append(f"times to {end:g}, compared with chains to {self.horizon:g}")
        if own is None:
            return [*found, "chains that are described, where its own energies came without a scene"]
        return found + differences(scene, own, self.starts)

    def plot_rates(self, ax: Axes | None = None) -> Axes:
        """:attr:`rates` as colors (Fig. 17), the diagonal as rates of loss -Q_ss, on axes of a figure of its own if none are given."""
        ax = plots.own_axes() if ax is None else ax
        return plots.rate_map(ax, self.rates.detach().cpu().numpy(), self.rates_meaning)

    def coarsened(self, n_bands: int) -> MasterEquation:
        """The model of fewer and wider bands, each of several of the present ones, for energy spread evenly in a band.

        Exact for a model with memory (of a compact one, for the nearest with memory): its transfer is averaged over the sources and summed over the receivers of a
        band. More bands than were calibrated, or rates alone, cannot be had this way.

        Raises:
            FieldError: for a number of bands that does not divide the present one, or a model without memory.
        """
        return MasterEquation(*coarsen(self.model, self.calibration, self.uncertainty, n_bands))

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
        """Write the model as safetensors, all or nothing.

        Raises:
            FieldError: where the file cannot be written, and for a report whose numbers are not finite.
        """
        file.save((self.model, self.calibration, self.uncertainty, self.starts), path)

    @classmethod
    def load(cls, path: str | Path) -> MasterEquation:
        """Read a saved model; every field is checked.

        Raises:
            FieldError: naming the file and what is wrong with it.
        """
        return cls(*file.load(path))
