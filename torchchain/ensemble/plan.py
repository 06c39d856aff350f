"""The smallest model and the cheapest method that meet a scene, with predicted error and time, and reasons in words."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import torch

from torchchain import checks
from torchchain.ensemble.contact_models import ContactModel, contact_models
from torchchain.ensemble.lattice_facts import LatticeFacts
from torchchain.ensemble.layout import Layout, layout
from torchchain.ensemble.predictions import TRIG, Facts, cost, error_of, facts_of, settle
from torchchain.ensemble.printed import Printed
from torchchain.ensemble.scene import Scene
from torchchain.threads import single_thread

ARTIFACT = "master equation"
THEORY = "theory"
STAND_INS = (ARTIFACT, THEORY)
"""What can take the place of the chains."""
ORDERED_TOLERANCE = 1e-9  # relative to the scale of the observables, where chains are all the same
FRACTION_OF_NOISE = 1 / 3  # adds 5 % to the statistical error
CONTACT_FRACTION = 0.9  # of the tolerance that linear contacts may take up; the method has the rest
SMALL_WORK = 0.008  # seconds of work that are not worth loading compiled kernels for, which takes half a second
RUN_SECONDS = 3e-3  # of any run
CPU = torch.device("cpu")


@dataclass(frozen=True)
class Choice:
    """One way to run a scene.

    Attributes:
        method, options, dtype: of the run.
        predicted_error: of the method, relative to the scale of the observables.
        cost: seconds of one nominal core: it ranks the ways, the same on every machine.
        predicted_seconds: wall time on this machine.
        allowed: error up to which the way will do.

    Example:
        >>> [choice.good for choice in tc.plan(tc.Scene(n_particles=64, n_bands=8, tolerance=1e-3)).choices][:2]
        [True, True]
    """

    method: str
    options: dict[str, Any]
    predicted_error: float
    cost: float
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


@dataclass(frozen=True, repr=False)
class Plan(Printed):
    """How a scene will be run.

    Attributes:
        scene: the scene with its contact law settled.
        method: name in ``evolvers.METHODS``, "master equation" for an artifact at hand, or "theory" where no chains are needed.
        options: of the method.
        dtype: precision of the chains.
        tolerance: error that the plan keeps to, relative to the scale of the observables.
        predicted_error: of the method, in the same measure; the ensemble's own error comes on top.
        predicted_seconds: wall time on this machine.
        reach: particles that the wave can have set in motion by the last time.
        reasons: why, in plain words.
        runners_up: the other ways that meet the tolerance, and those that do not, by predicted time.
        cost: seconds of one nominal core.
        contact_models: linear, linear plus quadratic and Hertz contacts, with the edge where each stops being enough; of
            standing waves on undamped chains, else none.

    Example:
        >>> plan = tc.plan(tc.Scene(n_particles=4096, boundary="fixed", excitation=tc.Impulse(), observables=("center",), tolerance=1e-8))
        >>> plan.method, plan.predicted_error < 1e-8, len(plan.reasons) > 0
        ('chebyshev', True, True)
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
    cost: float = 0.0
    contact_models: tuple[ContactModel, ...] = ()

    @property
    def run_options(self) -> dict[str, Any]:
        """The options of a run: the method's own, and the precision where it is not float64."""
        return {**self.options, **({"dtype": "float32"} if self.dtype == torch.float32 else {})}

    @property
    def choices(self) -> tuple[Choice, ...]:
        """The chosen way and all others."""
        error, seconds = self.predicted_error, self.predicted_seconds
        best = Choice(self.method, self.options, error, self.cost, seconds, self.tolerance, self.dtype)
        return (best, *self.runners_up)

    def _rows(self) -> dict[str, str]:
        best, *others = self.choices
        near = [
            f"{other} {other.predicted_seconds:.2g} s{'' if other.good else ', too coarse'}" for other in others[:3]
        ]
        return {
            "method": f"{replace(best, dtype=torch.float64)}, {str(self.dtype).removeprefix('torch.')}, "
            + (f"{self.scene.contact} contacts" if self.scene.lattice is None else "linear bonds"),
            "error": f"{self.predicted_error:.1e} predicted, tolerance {self.tolerance:.1e}",
            "time": f"{self.predicted_seconds:.2g} s predicted",
            "moving": f"{self.reach} of {self.scene.n_particles} particles",
            "because": "\n".join([*self.reasons[:3], *(["; ".join(self.reasons[3:])] if self.reasons[3:] else [])]),
            "runner-up": "; ".join(near) or "none",
        }

    def __str__(self) -> str:
        return repr(self)


StandIn = Callable[[Scene, float], tuple[list[Choice], list[str]]]
"""What could take the place of the chains of a scene within a tolerance, and what is to be said of it."""


def plan(scene: Scene, stand_in: StandIn | None = None) -> Plan:
    """The cheapest way to a scene whose predicted error is within its tolerance.

    Without a tolerance the method's error may be a third of the statistical error of the ensemble, to which it adds
    5 %: a finer integrator would be waste. Errors come from each method's own theory, costs from counted work on a
    nominal core, so that a scene has one plan on every machine and at every time.

    Args:
        scene: what is wanted.
        stand_in: what else could give the observables.

    Returns:
        Plan, whose ``str`` is the table that ``torchchain plan`` prints.

    Raises:
        FieldError: if no method can treat the scene, or none reaches the tolerance.
    """
    checks.instance("scene", scene, Scene)
    with single_thread():
        return _plan(scene, stand_in)


def _plan(scene: Scene, stand_in: StandIn | None) -> Plan:
    facts = facts_of(scene if scene.contact != "auto" else replace(scene, contact="linear"))
    tolerance, reasons = _tolerance(scene)
    asked = scene.contact
    scene, facts, why, off = _settled(scene, facts, tolerance)
    models = _contact_models(scene, facts, tolerance)
    layouts = {name: _layout(name, scene) for name in scene.methods if _can(name, scene)}
    usable = {name: found for name, found in layouts.items() if found is not None}
    if not usable:
        raise checks.fail("method", "treat the scene's contact, boundary, damping and size", "none")
    choices = []
    for name, cut in usable.items():
        for dtype in (torch.float64, torch.float32)[: 1 + scene.methods[name].single_precision]:
            options, error = settle(name, facts, tolerance - off, dtype)
            work, seconds = _seconds(name, facts, options, dtype, cut)
            choices.append(Choice(name, options, error + off, work, seconds, tolerance, dtype))
    remarks: list[str] = []
    if stand_in is not None:
        found, remarks = stand_in(scene, tolerance)
        choices += found
    choices = sorted(choices, key=lambda choice: choice.cost)
    good = [choice for choice in choices if choice.good]
    if not good:
        nearest = min(choices, key=lambda choice: choice.predicted_error)
        raise checks.fail(
            "tolerance",
            f"be at least {nearest.predicted_error:.1e}, what method '{nearest.method}' reaches here",
            tolerance,
        )
    loaded = [choice for choice in good if choice.method in STAND_INS or not scene.methods[choice.method].compiled]
    best = loaded[0] if loaded and loaded[0].cost < SMALL_WORK else good[0]
    if models and (asked != "linear" or not models[0].enough):
        remarks = [*remarks, _contact_words(models)]
    reasons = [*reasons, *why, *_method_reasons(best, good, facts, usable), *remarks]
    return Plan(
        scene, best.method, best.options, best.dtype, best.allowed, best.predicted_error, best.predicted_seconds,
        facts.n if isinstance(facts, Facts) and facts.part is not None else math.ceil(facts.moving()), tuple(reasons),
        tuple(choice for choice in choices if choice is not best), best.cost, models,
    )  # fmt: skip


def _contact_models(scene: Scene, facts: Facts | LatticeFacts, tolerance: float) -> tuple[ContactModel, ...]:
    """What was measured of waves spread over the chain; a pulse spreads and soon is linear, see :attr:`Facts.accumulated`."""
    if isinstance(facts, LatticeFacts) or facts.impulse or scene.largest_damping > 0:
        return ()
    return contact_models(facts.mean_elongation, facts.end, tolerance)


def _contact_words(models: tuple[ContactModel, ...]) -> str:
    """The ladder of contact laws, in words."""
    steps = [f"{each.name} {each.error:.1e} (enough to elongation {each.edge:.2g})" for each in models[:2]]
    least = next(each.name for each in models if each.enough)
    return (
        f"energies that Hertz contacts move between frequencies: {', '.join(steps)}; {least} contacts are enough here"
    )


def _seconds(
    name: str, facts: Facts | LatticeFacts, options: dict[str, Any], dtype: torch.dtype, cut: Layout
) -> tuple[float, float]:
    """Seconds of one nominal core, and wall time here."""
    chunk = min(cut.group if not cut.fused else max(cut.group, cut.largest), max(1, facts.chains // 4))
    work = facts.chains * cost(name, facts, options, dtype, chunk)
    chunks = cut.chunks(facts.chains)
    parallel = min(chunks.workers, math.ceil(facts.chains / chunks.size))
    return work, RUN_SECONDS + work * speed() / parallel


@cache
def speed() -> float:
    """How many times as long as the nominal core a core of this machine takes, from some milliseconds of work."""
    values = torch.linspace(0, 50, 2**14, dtype=torch.float64)
    spent = []
    with single_thread():
        for _ in range(30):
            begin = time.thread_time()
            for _ in range(10):
                values.cos()
            spent.append(time.thread_time() - begin)
    return min(spent) / (10 * len(values) * TRIG)


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
    if how["method"] not in scene.methods or not scene.methods[how["method"]].candidate:
        return measured
    options = json.loads(how["method_options"])
    dtype = torch.float32 if options.pop("dtype", "") == "float32" else torch.float64
    with single_thread():
        facts = facts_of(scene)
        suggested, error = settle(how["method"], facts, _tolerance(scene)[0], dtype)
        options = {**suggested, **options}
        if options != suggested:
            error = error_of(how["method"], facts, options, dtype)
        predicted = _seconds(how["method"], facts, options, dtype, layout(scene, how["method"], CPU))[1]
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
        return _settled(scene, facts_of(replace(scene, contact="linear")), _tolerance(scene)[0])[0]


def statistical_error(scene: Scene) -> float:
    """Rough standard error of an ensemble mean relative to the scale of the observable: xi / (2 sqrt(R)), of mixtures the species' spread."""
    kinds = [scene.disorder.strength, scene.stiffness_disorder.strength if scene.stiffness_disorder else 0.0]
    if scene.mixture is not None:
        kinds.append(scene.mixture.spread)
    return min(1.0, max(kinds)) / (2 * math.sqrt(scene.realizations))


def _tolerance(scene: Scene) -> tuple[float, list[str]]:
    """The error to keep to, and why."""
    if scene.tolerance is not None:
        return scene.tolerance, [f"tolerance {scene.tolerance:.1e} asked for"]
    if scene.is_ordered:
        return ORDERED_TOLERANCE, [f"no tolerance asked for and no ensemble error: {ORDERED_TOLERANCE:.0e}"]
    noise = statistical_error(scene)
    why = f"no tolerance asked for: a third of the ensemble's own error, about {noise:.1e}"
    return max(FRACTION_OF_NOISE * noise, ORDERED_TOLERANCE), [why]


def _settled(
    scene: Scene, facts: Facts | LatticeFacts, tolerance: float
) -> tuple[Scene, Facts | LatticeFacts, list[str], float]:
    """The scene with its contact law, what it takes, why, and the error that the law chosen makes already."""
    if isinstance(facts, LatticeFacts):
        return scene, facts, [f"lattices of {facts.n} unknowns and {facts.n_bonds} bonds"], 0.0
    size = f"elongation about {facts.elongation:.1e} of the overlap, force off by {100 * facts.deviation:.1e} %"
    if scene.contact != "auto":
        other = " by linear ones" if scene.contact == "hertz" else " from Hertz contacts"
        return scene, facts, [f"{scene.contact.capitalize()} contacts asked for: {size}{other}"], 0.0
    off = facts.accumulated
    growing = f"{size} and energies by up to {off:.1e} at the last time"
    if off <= CONTACT_FRACTION * tolerance:
        return replace(scene, contact="linear"), facts, [f"linear contacts: {growing}, within the tolerance"], off
    try:
        scene = replace(scene, contact="hertz")
    except checks.FieldError as error:
        told = str(error).rpartition(", got ")[0]
        raise checks.FieldError(f"{told}, got 'auto' and {growing}, {tolerance:.1e} allowed") from None
    return scene, Facts(scene), [f"Hertz contacts: with linear ones {growing}, more than the tolerance allows"], 0.0


def _can(name: str, scene: Scene) -> bool:
    """Whether the plan weighs the method for the scene."""
    entry = scene.methods[name]
    fits = entry.candidate and scene.boundary in (*entry.boundaries, "free") and scene.contact in entry.contacts
    if scene.largest_damping > 0:
        return fits and entry.damped
    if "rtol" in entry.options and scene.contact == "linear":
        return False  # the other methods are exact there
    return fits and not (entry.damped and entry.matrices)  # twice the matrices of the undamped modes


def _layout(name: str, scene: Scene) -> Layout | None:
    """The layout of the scene by a method, or None where the memory is not enough for one realization."""
    try:
        return layout(scene, name, CPU)
    except checks.FieldError:
        return None


def _method_reasons(
    best: Choice, good: list[Choice], facts: Facts | LatticeFacts, layouts: Mapping[str, Layout]
) -> list[str]:
    reasons = [] if best.method in STAND_INS else [f"'{best.method}': {facts.scene.methods[best.method].summary}"]
    if best is not good[0]:
        reasons.append(f"'{good[0]}' would be faster, but {SMALL_WORK:g} s of work are not worth loading its kernels")
    elif len(good) > 1:
        ratio = good[1].cost / max(best.cost, 1e-12)
        reasons.append(f"next best '{good[1]}' is predicted to take {ratio:.1f} times as long")
    if best.dtype == torch.float32:
        reasons.append("float32 is accurate enough here, and its loops are faster")
    if isinstance(facts, Facts) and facts.part is not None:
        n, whole = facts.n, facts.scene.n_particles
        reasons.append(f"the wave reaches {n} of {whole} particles by the last time: the others are left out")
    if best.method not in STAND_INS:
        cut = layouts[best.method].chunks(facts.chains)
        reasons.append(
            f"{facts.scene.kind}s {facts.chains}, in chunks of {min(cut.size, facts.chains)}, {cut.workers} side by side"
        )
    return reasons
