"""The smallest model and the cheapest method that meet a scene, with predicted error and time, and reasons in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch

from torchchain import checks
from torchchain.evolvers import METHODS
from torchchain.evolvers.linearity import elongation_estimate, force_deviation
from torchchain.excitation import Impulse
from torchchain.machine import Machine, chebyshev_work, this_machine
from torchchain.scene import BAND_OBSERVABLES, Scene

MOMENTS = frozenset({"center", "total_energy", "width"})
CANDIDATES = ("modes", "tridiagonal", "chebyshev", "verlet", "symplectic4", "damped")
EPS = torch.finfo(torch.float64).eps


@dataclass(frozen=True)
class Choice:
    """One way to run a scene: method and options, what it is predicted to cost and to err."""

    method: str
    options: dict[str, Any]
    predicted_error: float
    predicted_seconds: float


@dataclass(frozen=True)
class Plan:
    """How a scene will be run.

    Attributes:
        method: name in ``evolvers.METHODS``.
        options: of the method.
        dtype: precision of the chains.
        tolerance: error that the plan keeps to, relative to the scale of the observables.
        predicted_error: of the method, in the same measure; the ensemble's own error comes on top.
        predicted_seconds: wall time on this machine.
        reach: particles that the wave can have reached by the last time.
        reasons: why, in plain words.
        runners_up: the other ways that meet the tolerance, and those that do not, by predicted time.
    """

    method: str
    options: dict[str, Any]
    dtype: torch.dtype
    tolerance: float
    predicted_error: float
    predicted_seconds: float
    reach: int
    reasons: tuple[str, ...]
    runners_up: tuple[Choice, ...] = field(default=())

    def __str__(self) -> str:
        options = ", ".join(f"{name}={value:.3g}" for name, value in self.options.items())
        lines = [
            f"method     {self.method}" + (f" ({options})" if options else ""),
            f"precision  {str(self.dtype).removeprefix('torch.')}",
            f"tolerance  {self.tolerance:.1e}",
            f"error      {self.predicted_error:.1e} predicted",
            f"time       {self.predicted_seconds:.2g} s predicted",
            f"reach      {self.reach} particles",
            *(f"because    {reason}" for reason in self.reasons),
            *(
                f"runner-up  {other.method}: {other.predicted_seconds:.2g} s, error {other.predicted_error:.1e}"
                + ("" if other.predicted_error <= self.tolerance else ", too large")
                for other in self.runners_up
            ),
        ]
        return "\n".join(lines)


def plan(scene: Scene, machine: Machine | None = None) -> Plan:
    """The cheapest method for a scene whose predicted error is within its tolerance.

    Without a tolerance the method's error may be a tenth of the statistical error of the ensemble, no less: a finer
    integrator would be waste. Errors come from each method's own theory, times from counted work and a few speeds of
    the machine; both are rough, and good enough to order methods.

    Args:
        scene: what is wanted.
        machine: speeds; None for this machine's own (measured once, then cached).

    Returns:
        Plan, whose ``str`` is the table that ``torchchain plan`` prints.

    Raises:
        FieldError: if no method can treat the scene, or none reaches the tolerance.
    """
    machine = machine or this_machine()
    facts = _Facts(scene)
    statistical = statistical_error(scene)
    if scene.tolerance is not None:
        tolerance, why = scene.tolerance, f"tolerance {scene.tolerance:.1e} asked for"
    elif scene.is_ordered:
        tolerance, why = 1e-9, "no tolerance asked for and no ensemble error: 1e-9"
    else:
        tolerance = 0.1 * statistical
        why = f"no tolerance asked for: a tenth of the ensemble's own error, about {statistical:.1e}"
    usable = [name for name in CANDIDATES if _can(name, scene)]
    if not usable:
        raise checks.fail("method", "treat the scene's contact, boundary and damping", "none")
    choices = sorted(
        (_choice(name, scene, facts, tolerance, machine) for name in usable),
        key=lambda choice: choice.predicted_seconds,
    )
    good = [choice for choice in choices if choice.predicted_error <= tolerance]
    if not good:
        nearest = min(choices, key=lambda choice: choice.predicted_error)
        raise checks.fail(
            "tolerance",
            f"be at least {nearest.predicted_error:.1e}, what method '{nearest.method}' reaches here",
            tolerance,
        )
    best = good[0]
    reasons = [why, *_contact_reason(scene, facts), *_method_reason(best, good, facts, machine)]
    return Plan(
        best.method, best.options, torch.float64, tolerance, best.predicted_error, best.predicted_seconds, facts.reach,
        tuple(reasons), tuple(choice for choice in choices if choice is not best),
    )  # fmt: skip


def statistical_error(scene: Scene) -> float:
    """Rough standard error of an ensemble mean relative to the scale of the observable: xi / (2 sqrt(R))."""
    kinds = [scene.disorder.strength, scene.stiffness_disorder.strength if scene.stiffness_disorder else 0.0]
    return min(1.0, max(kinds)) / (2 * math.sqrt(scene.realizations))


class _Facts:
    """What the predictions need to know of a scene, from its first chain."""

    def __init__(self, scene: Scene) -> None:
        chain = scene.chain([0])
        state = scene.state(chain)
        self.n = scene.n_particles
        self.rows = max(1, len(scene.tones))
        self.realizations = 1 if scene.is_ordered else scene.realizations
        self.count = len(scene.times)
        self.end = float(scene.times[-1])
        self.highest = float(chain.squared_frequency_bound(sweeps=8).max().sqrt())
        self.limit = float(chain.squared_frequency_bound(sweeps=8).max().sqrt()) * 1.15  # over the whole ensemble
        spread = self.limit * self.end / 2 + 12 * (1 + self.limit * self.end) ** (1 / 3)
        self.impulse = isinstance(scene.excitation, Impulse)
        self.sides = 1 if self.impulse and self._at_wall(scene) else 2
        self.reach = int(min(self.n, 1 + self.sides * spread)) if self.impulse else self.n
        # Mean over time of the share of the chain that the stencil touches.
        times_to_fill = min(1.0, self.reach / self.n)
        full = min(1.0, self.n / max(1.0, self.sides * spread))
        self.touched = (
            1.0 if not self.impulse else (1 - full / 2 if spread * self.sides > self.n else times_to_fill / 2)
        )
        # The frequencies that carry the energy: an impulse has all of the band, a tone its own.
        tones = scene.tones
        self.typical = 2.0 if not tones else 2 * math.sin(math.pi * max(tones) / self.n)
        self.elongation = float(elongation_estimate(chain, state).max())
        self.deviation = float(force_deviation(torch.tensor(self.elongation, dtype=torch.float64)))

    def _at_wall(self, scene: Scene) -> bool:
        assert isinstance(scene.excitation, Impulse)
        return scene.boundary == "fixed" and scene.excitation.site in (1, scene.n_particles)


def _can(name: str, scene: Scene) -> bool:
    entry = METHODS[name]
    fits = scene.boundary in entry.boundaries and scene.contact in entry.contacts
    return fits and (scene.damping == 0 or entry.damped) and not (name == "damped" and scene.damping == 0)


def _choice(name: str, scene: Scene, facts: _Facts, tolerance: float, machine: Machine) -> Choice:
    """Counted work and theoretical error of a method for a scene."""
    points = facts.rows * facts.count * facts.n
    chains = facts.realizations
    bands = bool(BAND_OBSERVABLES & set(scene.observables))
    phase = facts.limit * facts.end
    options: dict[str, Any] = {}
    if name in ("modes", "tridiagonal"):
        each = machine.decomposition if name == "modes" else machine.tridiagonal
        directions = 2
        seconds = each * facts.n**3 + 2 * directions * points * facts.n * machine.flop + points * machine.entry
        return Choice(name, options, EPS * (40 + 4 * phase), chains * seconds / machine.cores)
    if name == "damped":
        seconds = 60 * machine.decomposition * facts.n**3 + 8 * points * facts.n * machine.flop + points * machine.entry
        return Choice(name, options, EPS * (400 + 40 * phase), chains * seconds)
    if name == "chebyshev":
        accuracy = max(1e-13, min(1e-10, tolerance / 10))  # coarser saves next to nothing
        step = phase / max(1, facts.count - 1)
        work = facts.touched * points * chebyshev_work(step, accuracy) if facts.count > 1 else 0.0
        work = max(work, facts.touched * facts.rows * facts.n * phase)
        seconds = work * machine.stencil
        if bands:
            seconds += points * machine.transform
        elif not MOMENTS.issuperset(scene.observables):
            seconds += points * machine.entry / machine.cores
        if "long_time_band_energy" in scene.observables:
            seconds += machine.decomposition * facts.n**3 / machine.cores
        error = accuracy + EPS * (40 + 8 * math.sqrt(phase))
        return Choice(name, {"accuracy": accuracy}, error, chains * seconds + machine.compilation)
    # Phase error of a step h: constant * w^(p + 1) h^p t, and for energies twice that.
    order, constant, evaluations, limit = {"verlet": (2, 1 / 24, 1, 2.0), "symplectic4": (4, 1.5e-3, 4, 2.9894)}[name]
    scale = 2 * constant * facts.typical ** (order + 1) * max(facts.end, 1e-300)
    step = min((0.5 * tolerance / scale) ** (1 / order), 0.5 * limit / facts.limit)
    if scene.contact == "hertz":
        step /= 1.5
    options["step"] = step
    error = scale * step**order + EPS * math.sqrt(max(1.0, facts.end / step)) * 20
    law = 4.0 if scene.contact == "hertz" else 1.0
    updates = facts.rows * facts.n * max(facts.end / step, facts.count) * evaluations
    seconds = updates * machine.update * law + points * machine.entry / machine.cores
    return Choice(name, options, error, chains * seconds + machine.compilation / 2)


def _contact_reason(scene: Scene, facts: _Facts) -> list[str]:
    if scene.contact == "hertz":
        small = (
            f"; linear contacts would be off by {100 * facts.deviation:.1e} % of the force"
            if facts.deviation < 0.05
            else ""
        )
        return [f"Hertz contacts asked for (elongation about {facts.elongation:.1e} of the overlap){small}"]
    return [
        f"linear contacts: elongation about {facts.elongation:.1e} of the overlap, force off by {100 * facts.deviation:.1e} %"
    ]


def _method_reason(best: Choice, good: list[Choice], facts: _Facts, machine: Machine) -> list[str]:
    reasons = [f"'{best.method}': {METHODS[best.method].summary}"]
    if len(good) > 1:
        ratio = good[1].predicted_seconds / max(best.predicted_seconds, 1e-12)
        reasons.append(f"next best '{good[1].method}' is predicted to take {ratio:.1f} times as long")
    if facts.reach < facts.n:
        reasons.append(f"the wave reaches {facts.reach} of {facts.n} particles by the last time")
    if machine.compilation and best.method not in ("chebyshev", "verlet", "symplectic4"):
        reasons.append(f"compiling the stencil's kernels first would take about {machine.compilation:.0f} s")
    return reasons
