"""What the plan needs to know of a scene of lattices: how far each method will be off there, and what it will cost."""

from __future__ import annotations

import math
from typing import Any

import torch

from torchchain.ensemble.observables import chosen_observables
from torchchain.ensemble.scene import Scene
from torchchain.evolvers.expansion import LEAP, LONGEST, SHARED_PHASE, terms

EPS = 2.0**-53
SPREAD = 1.1  # the highest frequency of all lattices over that of the first
# Seconds on one core of the same server as those of chains, see predictions.
DECOMPOSITION, PRODUCT = 3e-10, 2.1e-11  # per unknown^3; of a product of matrices
BOND, SUM = 4e-9, 1e-9  # a bond's pull and one term of an output's sum, per component
TRANSFORM, SPACE = 9e-9, 3e-9  # band energies per unknown and polarization; energies in space per bond
LOOP, CALLS = 1.5e-6, 6e-3  # a kernel's start; a lattice's masses, checks and bound


class LatticeFacts:
    """What the predictions need to know of a scene of lattices, from its first realization.

    Attributes:
        n: unknowns.
        rows: starts per lattice.
        chains: realizations that are computed, one where all are the same.
        n_bonds, bonds: per lattice, and times the displacements per particle.
        top: a frequency that none exceeds.
        part: None, as all of a lattice is computed.
    """

    part = None

    def __init__(self, scene: Scene) -> None:
        assert scene.lattices is not None, "of lattices"
        self.scene, self.n = scene, scene.n_particles * scene.n_components
        self.rows, self.chains = max(1, len(scene.tones)), scene.distinct_realizations
        first = scene.system([0])
        self.top = SPREAD * float(first.squared_frequency_bound().max().clamp(min=1e-300).sqrt())
        self.n_bonds = scene.lattices.n_bonds
        self.bonds = self.n_bonds * scene.n_components
        self.end = float(scene.times[-1])
        self.gaps = torch.cat([scene.times[:1], scene.times.diff()])

    def moving(self) -> float:
        """Particles that move: all."""
        return float(self.scene.n_particles)

    def settle(self, method: str, tolerance: float) -> tuple[dict[str, Any], float]:
        """The coarsest options of a method that keep to the tolerance, and the error predicted for them."""
        options: dict[str, Any] = {}
        if method == "chebyshev":
            options = {"accuracy": max(1e-13, min(1e-4, tolerance / 20))}
        elif method == "verlet":
            step = (0.9 * tolerance / self._step_error()) ** 0.5
            slow = max(self.top, 2 * self.scene.damping * self.top**2)
            options = {"step": min(step, 1.4 / slow, self.end or 1.0)}
        return options, self.error_of(method, options)

    def error_of(self, method: str, options: dict[str, Any]) -> float:
        """Predicted error of a method, relative to the scale of the observables; infinite where it cannot be used."""
        rounding = EPS * (2000 + 40 * self.top * self.end)
        if method == "verlet":
            return self._step_error() * options["step"] ** 2 + rounding
        if self.n > self.scene.methods[method].most_unknowns:
            return math.inf
        return 5 * options.get("accuracy", 0.0) + rounding

    def _step_error(self) -> float:
        """Verlet's phase errors w^3 step^2 t / 24 at the highest frequency, in the energies twice that."""
        return self.top**3 * max(self.end, 1.0) / 12

    def cost(self, method: str, options: dict[str, Any]) -> float:
        """Seconds of a lattice on one nominal core."""
        n, states = self.n, self.rows * len(self.gaps)
        observables = chosen_observables(self.scene.observables)
        seconds = CALLS
        if method == "modes" or any(not entry.in_time for entry in observables):
            seconds += DECOMPOSITION * n**3
        if method == "modes":
            seconds += 4 * states * n**2 * PRODUCT
        elif method == "damped":
            different = len(set(self.gaps.tolist()))
            seconds += 8 * (20 * different + 2 * states / max(n, 1)) * n**3 * PRODUCT
        elif method == "verlet":
            seconds += float((self.gaps / options["step"]).ceil().sum()) * self.rows * (4 * self.bonds * BOND + LOOP)
        else:
            seconds += self._chebyshev(options["accuracy"])
        bands = n * (TRANSFORM + 6 * self.scene.n_bands * PRODUCT)
        return seconds + sum(states * (bands if e.bands else self.bonds * SPACE) for e in observables if e.in_time)

    def _chebyshev(self, accuracy: float) -> float:
        products = sums = 0.0
        for phase in (self.top * self.gaps[self.gaps > 0]).tolist():
            outputs = min(LONGEST, max(1, int(SHARED_PHASE / phase)))
            leaps = math.ceil(phase / LEAP)
            whole = leaps * terms(phase / leaps if leaps > 1 else phase * outputs, accuracy)
            products += 2 * whole / outputs
            sums += 4 * (whole if outputs == 1 else terms(phase * (outputs + 1) / 2, accuracy))
        return self.rows * (products * (self.bonds * BOND + LOOP) + sums * self.n * SUM)
