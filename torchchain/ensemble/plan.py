"""The smallest model and the cheapest method that meet a scene, with predicted error and time, and reasons in words."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from torchchain import checks
from torchchain.ensemble.layout import layout
from torchchain.ensemble.machine import Machine, this_machine
from torchchain.ensemble.predictions import Facts, error_of, seconds, settle
from torchchain.ensemble.scene import Scene
from torchchain.evolvers import METHODS
from torchchain.threads import single_thread

CANDIDATES = ("modes", "tridiagonal", "chebyshev", "verlet", "symplectic4", "damped", "dopri8")
# Only these keep what they compute in float32: the stencil kernels work in float64 whatever the input, and modes from
# a float32 eigen-solver miss the check of their orthogonality on chains of 1000 particles.
SINGLE = ("verlet", "symplectic4")
ARTIFACT = "master equation"
ORDERED_TOLERANCE = 1e-9
SHARE_OF_NOISE = 1 / 3  # adds 5 % to the statistical error


@dataclass(frozen=True)
class Choice:
    """One way to run a scene: method, options and precision, what it is predicted to cost and to err, and may err."""

    method: str
    options: dict[str, Any]
    predicted_error: float
    predicted_seconds: float
    allowed: float
    dtype: torch.dtype = torch.float64

    @property
    def good(self) -> bool:
        """Whether the error is within what is allowed."""
        return self.predicted_error <= self.allowed

    def __str__(self) -> str:
        options = [f"{name}={value:.3g}" for name, value in self.options.items()]
        options += ["float32"] if self.dtype == torch.float32 else []
        return self.method + (f" ({', '.join(options)})" if options else "")


@dataclass(frozen=True)
class Plan:
    """How a scene will be run.

    Attributes:
        scene: the scene with its contact law settled.
        method: name in ``evolvers.METHODS``, or "master equation" for an artifact at hand.
        options: of the method.
        dtype: precision of the chains.
        tolerance: error that the plan keeps to, relative to the scale of the observables.
        predicted_error: of the method, in the same measure; the ensemble's own error comes on top.
        predicted_seconds: wall time on this machine.
        reach: particles that the wave can have reached by the last time.
        reasons: why, in plain words.
        runners_up: the other ways that meet the tolerance, and those that do not, by predicted time.
    """

    scene: Scene
    method: str
    options: dict[str, Any]
    dtype: torch.dtype
    tolerance: float
    predicted_error: float
    predicted_seconds: float
    reach: int
    reasons: tuple[str, ...]
    runners_up: tuple[Choice, ...] = field(default=())

    @property
    def run_options(self) -> dict[str, Any]:
        """The options of a run: the method's own, and the precision where it is not float64."""
        return {**self.options, **({"dtype": "float32"} if self.dtype == torch.float32 else {})}

    @property
    def choices(self) -> tuple[Choice, ...]:
        """The chosen way and all others."""
        error, seconds = self.predicted_error, self.predicted_seconds
        return (Choice(self.method, self.options, error, seconds, self.tolerance, self.dtype), *self.runners_up)

    def __str__(self) -> str:
        best, *others = self.choices
        lines = [
            f"contact    {self.scene.contact}",
            f"method     {replace(best, dtype=torch.float64)}",
            f"precision  {str(self.dtype).removeprefix('torch.')}",
            f"tolerance  {self.tolerance:.1e}",
            f"error      {self.predicted_error:.1e} predicted",
            f"time       {self.predicted_seconds:.2g} s predicted",
            f"reach      {self.reach} of {self.scene.n_particles} particles",
            *(f"because    {reason}" for reason in self.reasons),
            *(
                f"runner-up  {other}: {other.predicted_seconds:.2g} s, error {other.predicted_error:.1e}"
                + ("" if other.good else ", too large")
                for other in others
            ),
        ]
        return "\n".join(lines)


StandIn = Callable[[Scene, float], tuple[list[Choice], list[str]]]
"""What could take the place of the chains of a scene within a tolerance, and what is to be said of it."""


def plan(scene: Scene, machine: Machine | None = None, stand_in: StandIn | None = None) -> Plan:
    """The cheapest way to a scene whose predicted error is within its tolerance.

    Without a tolerance the method's error may be a third of the statistical error of the ensemble, to which it adds
    5 %: a finer integrator would be waste. Errors come from each method's own theory, times from counted work and the
    speeds of the machine.

    Args:
        scene: what is wanted.
        machine: speeds; None for this machine's own (measured once, then cached).
        stand_in: what else could give the observables.

    Returns:
        Plan, whose ``str`` is the table that ``torchchain plan`` prints.

    Raises:
        FieldError: if no method can treat the scene, or none reaches the tolerance.
    """
    checks.instance("scene", scene, Scene)
    checks.instance("machine", machine, Machine, type(None))
    machine = machine or this_machine()
    with single_thread():
        return _plan(scene, machine, stand_in)


def _plan(scene: Scene, machine: Machine, stand_in: StandIn | None) -> Plan:
    facts = Facts(scene if scene.contact != "auto" else replace(scene, contact="linear"))
    tolerance, reasons = _tolerance(scene)
    scene, facts, why = _settled(scene, facts, tolerance)
    usable = [name for name in CANDIDATES if _can(name, scene) and _fits(name, scene)]
    if not usable:
        raise checks.fail("method", "treat the scene's contact, boundary, damping and size", "none")
    precisions = {name: (torch.float64, torch.float32) if name in SINGLE else (torch.float64,) for name in usable}
    choices = [_choice(name, facts, tolerance, dtype, machine) for name in usable for dtype in precisions[name]]
    remarks: list[str] = []
    if stand_in is not None:
        found, remarks = stand_in(scene, tolerance)
        choices += found
    choices = sorted(choices, key=lambda choice: choice.predicted_seconds)
    good = [choice for choice in choices if choice.good]
    if not good:
        nearest = min(choices, key=lambda choice: choice.predicted_error)
        raise checks.fail(
            "tolerance",
            f"be at least {nearest.predicted_error:.1e}, what method '{nearest.method}' reaches here",
            tolerance,
        )
    best = good[0]
    reasons = [*reasons, *why, *_method_reasons(best, good, facts, machine), *remarks]
    return Plan(
        scene, best.method, best.options, best.dtype, best.allowed, best.predicted_error, best.predicted_seconds,
        math.ceil(facts.moving(0)) if facts.reach is None else facts.n, tuple(reasons),
        tuple(choice for choice in choices if choice is not best),
    )  # fmt: skip


def forecast(scene: Scene, how: Mapping[str, Any], spent: float, statistical: float) -> dict[str, Any]:
    """What the plan predicts of a run that has been made, beside what was measured, for its record.

    Args:
        scene: what was run.
        how: its ``method`` and ``method_options`` (JSON), as results carry them.
        spent: seconds that it took.
        statistical: largest standard error of the ensemble, relative to the scale of the observable.

    Returns:
        predicted_seconds, seconds, predicted_error, statistical_error; no prediction for methods that no plan weighs.
    """
    measured = {"seconds": spent, "statistical_error": statistical}
    if how["method"] not in CANDIDATES:
        return measured
    options = json.loads(how["method_options"])
    dtype = torch.float32 if options.pop("dtype", "") == "float32" else torch.float64
    with single_thread():
        facts = Facts(scene)
        suggested, error = settle(how["method"], facts, _tolerance(scene)[0], dtype)
        if {**suggested, **options} != suggested:
            error = error_of(how["method"], facts, {**suggested, **options}, dtype)
        predicted = seconds(how["method"], facts, {**suggested, **options}, dtype, this_machine())
    return {"predicted_seconds": predicted, **measured, "predicted_error": error}


def forecast_line(record: Mapping[str, Any]) -> str:
    """The record of :func:`forecast` in words."""
    words = f"ensemble: {record['seconds']:.2g} s"
    if "predicted_seconds" in record:
        words += f" ({record['predicted_seconds']:.2g} s predicted), error of the method {record['predicted_error']:.1e} predicted"
    return words + f", standard error up to {record['statistical_error']:.1e} of the largest value"


def resolved(scene: Scene) -> Scene:
    """The scene with the contact law "auto" settled."""
    checks.instance("scene", scene, Scene)
    if scene.contact != "auto":
        return scene
    with single_thread():
        return _settled(scene, Facts(replace(scene, contact="linear")), _tolerance(scene)[0])[0]


def statistical_error(scene: Scene) -> float:
    """Rough standard error of an ensemble mean relative to the scale of the observable: xi / (2 sqrt(R))."""
    kinds = [scene.disorder.strength, scene.stiffness_disorder.strength if scene.stiffness_disorder else 0.0]
    return min(1.0, max(kinds)) / (2 * math.sqrt(scene.realizations))


def _tolerance(scene: Scene) -> tuple[float, list[str]]:
    """The error to keep to, and why."""
    if scene.tolerance is not None:
        return scene.tolerance, [f"tolerance {scene.tolerance:.1e} asked for"]
    if scene.is_ordered:
        return ORDERED_TOLERANCE, [f"no tolerance asked for and no ensemble error: {ORDERED_TOLERANCE:.0e}"]
    noise = statistical_error(scene)
    return SHARE_OF_NOISE * noise, [f"no tolerance asked for: a third of the ensemble's own error, about {noise:.1e}"]


def _settled(scene: Scene, facts: Facts, tolerance: float) -> tuple[Scene, Facts, list[str]]:
    """The scene with its contact law, what it takes, and why."""
    percent = f"{100 * facts.deviation:.1e} %"
    size = f"elongation about {facts.elongation:.1e} of the overlap"
    if scene.contact == "hertz":
        small = f"; linear contacts would be off by {percent} of the force" if facts.deviation < 0.05 else ""
        return scene, facts, [f"Hertz contacts asked for ({size}){small}"]
    if scene.contact == "linear":
        return scene, facts, [f"linear contacts: {size}, force off by {percent}"]
    if facts.deviation <= tolerance:
        why = f"linear contacts: {size}, force off by {percent}, within the tolerance"
        return replace(scene, contact="linear"), facts, [why]
    scene = replace(scene, contact="hertz")
    return scene, Facts(scene), [f"Hertz contacts: {size}, linear force off by {percent}, more than the tolerance"]


def _can(name: str, scene: Scene) -> bool:
    entry = METHODS[name]
    fits = scene.boundary in entry.boundaries and scene.contact in entry.contacts
    if name == "dopri8" and scene.contact == "linear" and scene.damping == 0:
        return False  # the other methods are exact there
    return fits and (scene.damping == 0 or entry.damped) and not (name == "damped" and scene.damping == 0)


def _fits(name: str, scene: Scene) -> bool:
    """Whether the memory is enough for one realization."""
    try:
        layout(scene, name, scene.observables, torch.device("cpu"))
    except checks.FieldError:
        return False
    return True


def _choice(name: str, facts: Facts, tolerance: float, dtype: torch.dtype, machine: Machine) -> Choice:
    options, error = settle(name, facts, tolerance, dtype)
    return Choice(name, options, error, seconds(name, facts, options, dtype, machine), tolerance, dtype)


def _method_reasons(best: Choice, good: list[Choice], facts: Facts, machine: Machine) -> list[str]:
    reasons = [] if best.method == ARTIFACT else [f"'{best.method}': {METHODS[best.method].summary}"]
    if len(good) > 1:
        ratio = good[1].predicted_seconds / max(best.predicted_seconds, 1e-12)
        reasons.append(f"next best '{good[1]}' is predicted to take {ratio:.1f} times as long")
    if best.dtype == torch.float32:
        reasons.append("float32 is accurate enough here, and its loops are faster")
    elif best.method == "chebyshev":
        reasons.append("float64: the stencil kernels compute in it whatever the input")
    if facts.reach is not None:
        n, whole = facts.n, facts.scene.n_particles
        reasons.append(f"the wave reaches {n} of {whole} particles by the last time: the others are left out")
    if best.method != ARTIFACT:
        cut = layout(facts.scene, best.method, facts.scene.observables, torch.device("cpu"))
        reasons.append(f"chains {facts.chains}, in chunks of {min(cut.size, facts.chains)}, {cut.workers} side by side")
    if machine.compilation and best.method not in ("chebyshev", "verlet", "symplectic4"):
        reasons.append(f"compiling the stencil's kernels first would take about {machine.compilation:.0f} s")
    return reasons
