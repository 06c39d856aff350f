"""Where a fit needs gradients: the same data by Adam, by other searches with the same gradients, and without any."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.optimize import least_squares, minimize
from torch import Tensor

import torchchain as tc
from torchchain import mixing

NODES = 8
"""Matrices of rates that Q(t) is linear between."""


@dataclass(frozen=True)
class Found:
    """One fit: what was fitted to what, by which tool, its processor time, and its error over that of two ensembles."""

    case: str
    tool: str
    seconds: float
    error: float


def searched(
    value: Callable[[np.ndarray], tuple[float, np.ndarray]], start: np.ndarray, steps: int, floor: float | None
) -> np.ndarray:
    """The least value by L-BFGS-B, from the same gradients that Adam has."""
    bounds = [(floor, None)] * len(start)
    return minimize(value, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": steps}).x


def rates_in_time(own: tc.BandTransfer, fresh: tc.BandTransfer, adam: int, newton: int) -> Iterator[Found]:
    """dE/dt = E Q(t), Q(t) linear between nodes, no rate negative, rows of sum 0: propagated by matrix exponentials."""
    times, n = own.times, own.n_bands
    picked = torch.linspace(0, math.sqrt(len(times) - 1), 60).square().round().long().unique()
    grid = times[picked]
    step, middle = grid.diff(), (grid[1:] + grid[:-1]) / 2
    clock = middle.sqrt() / (middle.sqrt() + math.sqrt(10))
    place = clock / clock[-1] * (NODES - 1)
    weight = (1 - (place[:, None] - torch.arange(NODES)).abs()).clamp(min=0)
    other, eye = 1 - torch.eye(n, dtype=torch.float64), torch.eye(n, dtype=torch.float64)
    data = own.mean[:, picked].double()

    def solved(raw: Tensor) -> Tensor:
        rates = torch.einsum("tk,ksr->tsr", weight, torch.nn.functional.softplus(raw) * 0.02 * other)
        rates = rates - torch.diag_embed(rates.sum(-1))
        path = [eye]
        for move in torch.linalg.matrix_exp(rates * step[:, None, None]):
            path.append(path[-1] @ move)
        return torch.stack(path, 1)

    def loss(raw: Tensor) -> Tensor:
        return 1e3 * (solved(raw) - data).square().sum(-1).mean()

    def error(raw: Tensor) -> float:
        noise = tc.total_variation(own.mean, fresh.mean)[:, picked[1:]].mean()
        return float(tc.total_variation(solved(raw.detach()), fresh.mean[:, picked])[:, 1:].mean() / noise)

    began = time.process_time()
    raw = torch.nn.Parameter(torch.full((NODES, n, n), -2.0, dtype=torch.float64))
    optimizer = torch.optim.Adam([raw], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, adam, eta_min=0.002)
    for _ in range(adam):
        optimizer.zero_grad()
        loss(raw).backward()
        optimizer.step()
        schedule.step()
    yield Found("rates in time", "Adam", time.process_time() - began, error(raw))

    def value(x: np.ndarray) -> tuple[float, np.ndarray]:
        here = torch.from_numpy(x).reshape(NODES, n, n).requires_grad_()
        there = loss(here)
        return float(there.detach()), torch.autograd.grad(there, here)[0].flatten().numpy()

    began = time.process_time()
    best = searched(value, np.full(NODES * n * n, -2.0), newton, None)
    yield Found(
        "rates in time", "L-BFGS", time.process_time() - began, error(torch.from_numpy(best).reshape(NODES, n, n))
    )


@dataclass(frozen=True, eq=False)
class Hertz:
    """Band energies of Hertz chains released from standing waves, per particle, and their errors, (start, time, band)."""

    times: Tensor
    energies: Tensor
    stderr: Tensor

    @classmethod
    def of(cls, scene: tc.Scene, amplitude: float, times: Tensor) -> Hertz:
        """Waves in the center tone of each band, of a largest displacement; ``scene`` for masses and bands."""
        chain = scene.chain(range(scene.realizations))
        wave = tc.standing_wave(chain, tone=list(scene.tones)).displacement
        wave = wave * (amplitude / wave.abs().amax(-1, keepdim=True))
        path = tc.evolve(replace(chain, contact="hertz"), tc.State(wave, 0 * wave), times, method="verlet", step=0.1)
        energy = tc.band_energy(chain, path, scene.n_bands, normalize=False) / scene.n_particles
        return cls(times, energy.mean(0), energy.std(0) / math.sqrt(len(energy)))

    def error(self, both: mixing.NonlinearMasterEquation | tc.MasterEquation) -> float:
        total = self.energies[:, 0].sum(-1)[:, None, None]
        if isinstance(both, tc.MasterEquation):
            found = both.solve(self.energies[:, 0].clamp(min=0), self.times) / total
        else:
            found = both.solve(self.energies[:, 0].clamp(min=0), self.times, energy_per_particle=1.0).detach() / total
        off = tc.total_variation(found, self.energies / total)[:, 1:].mean()
        return float(off / tc.statistical_distance(self.stderr / total)[:, 1:].mean())


def rates_by_amplitude(
    n_particles: int, n_bands: int, realizations: int, seed: int, strength: float, steps: int
) -> Iterator[Found]:
    """Couplings of triads from bands of wavenumber at two times, scored at twice the amplitude of the weaker data."""
    early, late = torch.arange(0, 5, 0.25, dtype=torch.float64), torch.arange(5, 201, 2.5, dtype=torch.float64)
    scene = tc.Scene(
        n_particles=n_particles, n_bands=n_bands, realizations=realizations, disorder=tc.Disorder(strength=strength),
        seed=seed, times=torch.cat([early, late]),
    )  # fmt: skip
    linear = tc.calibrate(tc.band_transfer(scene, starts=False), bootstrap=0)
    fresh = Hertz.of(replace(scene, seed=seed + 1), 0.2, torch.linspace(0, 200, 41, dtype=torch.float64))
    told = [Hertz.of(scene, amplitude, torch.tensor([0.0, 200.0], dtype=torch.float64)) for amplitude in (0.1, 0.15)]
    times, energies, stderr = told[0].times, torch.cat([x.energies for x in told]), torch.cat([x.stderr for x in told])
    bands = mixing.FrequencyBands.covering(scene.chain(range(8)), n_bands)
    name = "rates by amplitude, 2 times"
    yield Found(name, "none: linear model", 0.0, fresh.error(linear))
    began = time.process_time()
    both, _ = mixing.fit_trajectories(linear, times, energies, bands, stderr=stderr, steps=steps)
    yield Found(name, "Adam", time.process_time() - began, fresh.error(both))
    loss = mixing.TrajectoryLoss(linear, times, energies, bands, stderr)
    coupling = loss.model.triads.coupling

    def placed(x: np.ndarray) -> None:
        with torch.no_grad():
            coupling.copy_(torch.from_numpy(np.asarray(x) * unit))

    def value(x: np.ndarray) -> tuple[float, np.ndarray]:
        placed(x)
        there = loss()
        return float(there.detach()), torch.autograd.grad(there, coupling)[0].numpy() * unit

    @torch.no_grad()
    def residual(x: np.ndarray) -> np.ndarray:
        placed(x)
        return loss.residual().flatten().numpy()

    searches: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "L-BFGS": lambda start: searched(value, start, steps, 0.0),
        "least squares, differences": lambda start: least_squares(residual, start, bounds=(0, np.inf), max_nfev=10).x,
    }
    for tool, search in searches.items():
        began = time.process_time()
        unit = loss.scale()
        placed(search(np.ones(len(coupling))))
        yield Found(name, tool, time.process_time() - began, fresh.error(loss.model))
    modes = replace(scene, realizations=min(24, realizations), seed=seed + 2)
    measured = mixing.measure_mixing(modes, 0.1, bands)
    began = time.process_time()
    fit = mixing.fit_triads(measured, bootstrap=0)
    seconds = time.process_time() - began
    joined = mixing.NonlinearMasterEquation.of(linear, fit.model)
    yield Found("rates by amplitude, modes known", "linear least squares", seconds, fresh.error(joined))


def found(config: Any, own: tc.BandTransfer, fresh: tc.BandTransfer, smoke: bool) -> list[Found]:
    """Every case, with the settings of ``calibration_methods``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        steps = 3 if smoke else 60
        return [
            *rates_in_time(own, fresh, 3 if smoke else 300, 3 if smoke else 300),
            *rates_by_amplitude(*((32, 4, 8) if smoke else (64, 8, 100)), config.seed, config.strength, steps),
        ]
