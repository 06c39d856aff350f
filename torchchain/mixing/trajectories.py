"""Couplings of triads from energies in bands of wavenumber alone, by gradients through the solver.

What runs of other codes tell is energy over wavenumbers. How much of it lies in each band of frequency takes the modes of every
chain, without which no equation is linear in the couplings: they show only in where trajectories end. So the loss is the
distance of solved trajectories from measured ones, its gradient comes by autograd through torchdiffeq, and Adam follows it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.adam import AdamReport
from torchchain.master.equation import MasterEquation
from torchchain.mixing.bands import FrequencyBands
from torchchain.mixing.fit import CLOSURE
from torchchain.mixing.master import NonlinearMasterEquation, scene_of
from torchchain.mixing.triads import TriadModel, triads_of
from torchchain.modes.spectrum import normal_modes

FIRST = tuple(10 ** (power / 2) for power in range(-8, 3))
"""Strengths of equal couplings that are tried before the first step, in units of 1 / (last time x fastest triad)."""
SETTLED = 0.02
"""Share by which the loss may still fall in the last quarter of the steps of a fit that has converged."""
CHAINS = 32
"""Chains from which the modes of each band of frequency are counted."""


class TrajectoryLoss:
    """Mean squared distance of solved energies from measured ones, in units of their error, as a function of the couplings.

    Args:
        linear, times, energies, bands, stderr: see :func:`fit_trajectories`.
        rtol: of the solver.

    Attributes:
        model: a :class:`NonlinearMasterEquation` whose couplings are looked at.

    Example:
        >>> scene = tc.Scene(n_particles=32, n_bands=4, realizations=8, times=torch.linspace(0, 40, 41))
        >>> linear = tc.calibrate(tc.band_transfer(scene), model="paper", method="linear", bootstrap=0)
        >>> loss = tc.mixing.TrajectoryLoss(linear, [0.0, 40.0], torch.eye(4)[:, None].expand(-1, 2, -1) * 1e-3)
        >>> loss().backward(), tuple(loss.model.triads.coupling.grad.shape)
        (None, (77,))
    """

    def __init__(
        self, linear: MasterEquation, times: Any, energies: Any, bands: FrequencyBands | None = None,
        stderr: Any = None, rtol: float = 1e-4,
    ) -> None:  # fmt: skip
        scene = scene_of(linear)
        chain = scene.chain(range(min(CHAINS, scene.realizations)))
        bands = FrequencyBands.covering(chain) if bands is None else bands
        checks.instance("bands", bands, FrequencyBands)
        self.times = checks.times("times", times).double()
        if len(self.times) < 2 or float(self.times[0]) != 0:
            raise checks.fail("times", "be at least 2 from 0 on", self.times.tolist())
        energies = checks.real_tensor("energies", energies).double()
        if energies.ndim != 3 or tuple(energies.shape[1:]) != (len(self.times), linear.n_bands) or not len(energies):
            rule = f"have shape (start, {len(self.times)}, {linear.n_bands})"
            raise checks.fail("energies", rule, energies)
        total = energies[:, 0].sum(-1)
        checks.first_bad("energies", "not be zero at time 0", total, ~(total > 0), "start")
        self.start, self.total = energies[:, 0].clamp(min=0), total[:, None, None]
        self.measured = energies[:, 1:] / self.total
        error = torch.zeros_like(self.measured)
        if stderr is not None:
            given = checks.shaped("stderr", stderr, tuple(energies.shape)).double()
            checks.first_bad("stderr", "not be negative", given, given < 0, "band")
            error = given[:, 1:] / self.total
        self.weight = 1 / (error + CLOSURE)
        members = bands.members(normal_modes(chain).frequencies).sum((0, 1))
        checks.first_bad("bands", "hold modes of the chains each", members, members <= 0, "band")
        triads = TriadModel(
            bands, members / (len(chain.masses) * scene.n_particles), torch.zeros(len(triads_of(bands)[0]))
        )
        self.model = NonlinearMasterEquation.of(linear, triads)
        self.moved, self.rtol = linear.transfer(self.times).detach().double(), rtol

    def residual(self) -> Tensor:
        """What the model's couplings miss, in units of the error, (start, later time, band)."""
        found = self.model.joined(self.start, self.moved, self.times, 1.0, rtol=self.rtol)[:, 1:] / self.total
        return (found - self.measured) * self.weight

    def __call__(self) -> Tensor:
        """The loss of the model's couplings."""
        return self.residual().square().mean()

    @torch.no_grad()
    def scale(self) -> float:
        """Equal couplings near the least loss, from weak to strong ones; a first guess and the unit of a step."""
        triads = self.model.triads
        before = self.start @ self.model.spectrum
        each = (triads.flux(before)[..., None] * triads.exchange).abs().amax((-1, -2)) / before.sum(-1)
        unit = 1 / float(self.times[-1] * each.max().clamp(min=torch.finfo(torch.float64).tiny))
        best, least = FIRST[0] * unit, float("inf")
        for factor in FIRST:
            triads.coupling.fill_(factor * unit)
            value = float(self())
            if value > least:
                break
            best, least = factor * unit, value
        return best


def fit_trajectories(
    linear: MasterEquation,
    times: Any,
    energies: Any,
    bands: FrequencyBands | None = None,
    *,
    stderr: Any = None,
    steps: int = 60,
    learning_rate: float = 0.2,
    progress: Callable[[int], Any] | None = None,
) -> tuple[NonlinearMasterEquation, AdamReport]:
    """A :class:`NonlinearMasterEquation` from band energies of Hertz chains, without their modes, by Adam through the solver.

    The couplings are an ``nn.Parameter``, set to zero where a step has made them negative: energy is conserved and no band
    negative at every step, by the form of the equations. Where energies in bands of frequency are at hand,
    :func:`fit_triads` needs no gradients and is a hundred times faster.

    Args:
        linear: calibrated on a scene of the same disorder with linear contacts.
        times: (time,), 0 first; two are enough.
        energies: per particle in the bands of wavenumber, (start, time, band), in units of stiffness times overlap squared,
            of the motion as :func:`torchchain.band_energy` has it for linear contacts; means over ensembles.
        bands: of frequency; None: 12 that cover the modes of the linear model's scene.
        stderr: of the energies, (start, time, band); 0.3 % of the total comes on top. None: all count alike.
        steps: of Adam.
        learning_rate: in units of the first guess, equal couplings that come nearest.
        progress: called with 1 after every step.

    Returns:
        The model, and a report with the mean squared misfit before and after.

    Raises:
        FieldError: for a linear model without a scene, shapes that do not fit.

    Example:
        >>> scene = tc.Scene(n_particles=32, n_bands=4, realizations=8, times=torch.linspace(0, 40, 41))
        >>> linear = tc.calibrate(tc.band_transfer(scene), model="paper", method="linear", bootstrap=0)
        >>> chain = scene.chain(range(8))
        >>> path = tc.evolve(tc.Chain(chain.masses, contact="hertz"), tc.standing_wave(chain, tone=[2, 6, 10], amplitude=0.1),
        ...     [0.0, 20.0, 40.0], method="verlet", step=0.1)
        >>> energy = tc.band_energy(chain, path, 4, normalize=False).mean(0) / 32
        >>> both, report = tc.mixing.fit_trajectories(linear, path.times, energy, tc.mixing.FrequencyBands(4), steps=10)
        >>> report.loss <= report.first_loss
        True
    """
    steps = checks.integer("steps", steps, 1, 10**6)
    learning_rate = checks.number("learning_rate", learning_rate, above=0, at_most=10)
    loss = TrajectoryLoss(linear, times, energies, bands, stderr)
    coupling, unit = loss.model.triads.coupling, loss.scale()
    with torch.no_grad():
        coupling.fill_(unit)
    optimizer = torch.optim.Adam([coupling], lr=learning_rate * unit, eps=1e-12)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps, eta_min=learning_rate * unit / 50)
    losses, best, least = [], coupling.detach().clone(), float("inf")
    for step in range(steps + 1):
        optimizer.zero_grad()
        value = loss()
        losses.append(float(value.detach()))
        if losses[-1] < least:
            least, best = losses[-1], coupling.detach().clone()
        if step == steps:
            break
        value.backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            coupling.clamp_(min=0)
        if progress is not None:
            progress(1)
    with torch.no_grad():
        coupling.copy_(best)
    coupling.grad = None
    settled = least > (1 - SETTLED) * min(losses[: 1 + 3 * steps // 4])
    return loss.model, AdamReport(settled, steps, least, losses[0], "exact", 0.0)
