"""What a way to run a scene will take and how far it will be off: counted work, and each method's own theory."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from torchchain.chain.amplitude import elongation_estimate, force_deviation
from torchchain.chain.excitation import Impulse
from torchchain.chain.states import State
from torchchain.ensemble.layout import layout
from torchchain.ensemble.machine import Machine, kernels_loaded
from torchchain.ensemble.observables import MOMENTS
from torchchain.ensemble.reach import reach
from torchchain.ensemble.scene import BAND_OBSERVABLES, Scene
from torchchain.evolvers.expansion import LEAP, LONGEST, REACH, terms

EPS = {torch.float64: 2.0**-53, torch.float32: 2.0**-24}
SAMPLE = 4  # realizations that stand for the ensemble
SAMPLE_SIZE = 2**16  # particles in them
STEPPERS = {"verlet": (2, 1 / 24, 1, 2.0), "symplectic4": (4, 6e-5, 4, 2.98944)}  # order, phase error, forces, limit
# Elementwise passes over a state that an observable takes where the kernels do not measure it themselves.
PASSES = {
    "band_energy": 30, "center": 18, "displacement": 2, "dissipated": 0, "energy": 16, "openings": 0, "source_energy": 14,
    "total_energy": 12, "wavenumber_energy": 30, "width": 22,
}  # fmt: skip


class Facts:
    """What the predictions need to know of a scene, from a few of its chains.

    Attributes:
        n: particles that are computed, those that the wave reaches where the rest is cut off.
        reach: their range, or None for the whole chain.
        rows: starts per chain.
        chains: realizations that are computed, one where all are the same.
        typical: highest frequency of a chain.
        limit: frequency that is not expected to be exceeded in the whole ensemble.
        elongation, deviation: largest of the start, and of the Hertz force from the linear there.
        gaps: times from each output to the next, (time,).
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.reach = reach(scene)
        inner = scene if self.reach is None else self.reach.scene(scene)
        self.n = inner.n_particles
        self.rows = max(1, len(scene.tones))
        self.chains = scene.distinct_realizations
        sampled = max(1, min(SAMPLE, self.chains, SAMPLE_SIZE // self.n))
        chain = inner.chain(range(sampled))
        state = inner.state(chain)
        self.elongation = float(elongation_estimate(chain, state).max())
        self.deviation = float(force_deviation(torch.tensor(self.elongation, dtype=torch.float64)))
        self.gaps = torch.cat([scene.times[:1], scene.times.diff()])
        self.end = float(scene.times[-1])
        bounds = chain.squared_frequency_bound(sweeps=8).sqrt()
        self.typical, self.limit = float(bounds.mean()), self._limit(scene, float(bounds.max()))
        self._linear, self._state = replace(chain, contact="linear", damping=0.0), state
        self._frequencies: dict[int, float] = {}
        self.impulse = isinstance(scene.excitation, Impulse)
        later = self.gaps[self.gaps > 0]
        self.uniform = len(later) > 0 and bool((later - later[0]).abs().max() <= 1e-9 * self.end)

    @property
    def count(self) -> int:
        """Output times."""
        return len(self.gaps)

    def _limit(self, scene: Scene, bound: float) -> float:
        """The first chains' bound, or that of the lightest particle to expect among average ones, with a margin."""
        draws = max(2.0, 1.0 * self.chains * self.n)
        lightest = float(scene.disorder._quantile(torch.tensor([1 / draws], dtype=torch.float64).numpy())[0])
        single = math.sqrt(4 / (lightest * (2 - lightest))) if lightest < 1 else 2.0
        limit = max(bound, single) * (1.0 if scene.is_ordered else 1.1)
        return limit * (1 + self.elongation) ** 0.25 if scene.contact == "hertz" else limit

    def frequency(self, power: int) -> float:
        """The mean of w^power over the start, in the norm of the energy: |G^power x| / |x|, with dx/dt = G x.

        The shares of the modes never change in a linear chain, so that this is what a phase error in w^power does
        at all times. A wave in Hertz contacts makes harmonics, up to the highest frequency of the ordered chain.
        """
        if power in self._frequencies:
            return self._frequencies[power]
        state = self._state
        first = self._linear.energy(state.displacement, state.velocity)
        for _ in range(power):
            force = self._linear.force(state.displacement)
            state = State(state.velocity, force / self._linear.align(self._linear.masses, force))
        mean = float((self._linear.energy(state.displacement, state.velocity) / first).mean(0).max().sqrt())
        if self.scene.contact == "hertz":
            harmonics = min(1.0, self.deviation * self.end * mean ** (1 / power))
            mean = max(mean, harmonics * 2.0**power) * (1 + self.elongation) ** (power / 4)
        self._frequencies[power] = mean
        return mean

    @property
    def cancellation(self) -> float:
        """How much larger displacements are than elongations, whose rounding errors they bring: beyond tenfold.

        A wave of small k has 1 / k; a ring that is struck moves on as a whole, by v t / N against some v / sqrt(N).
        """
        largest = float(self._state.displacement.abs().max()) / (10 * self.elongation)
        drift = self.end / math.sqrt(self.n) if self.impulse and self.scene.boundary == "periodic" else 0.0
        return max(1.0, largest, drift)

    @property
    def growing(self) -> float:
        """The time over which phase errors grow: damping ends that of the fast modes."""
        return self.end if self.scene.damping == 0 else min(self.end, 1 / self.scene.damping)

    @property
    def bands(self) -> bool:
        return bool(BAND_OBSERVABLES & set(self.scene.observables))

    @property
    def in_time(self) -> list[str]:
        """The observables that need the states at the output times."""
        return [name for name in self.scene.observables if name in PASSES]

    def fused(self) -> bool:
        """Whether the stencil's kernels can measure the observables themselves."""
        return MOMENTS.issuperset(self.in_time) or self.in_time == ["band_energy"]

    def moving(self, ahead: float) -> float:
        """Mean over time of the particles that the stencil touches, ``ahead`` beyond those that move."""
        if not self.impulse:
            return float(self.n)
        site, n = self.scene.excitation.site, self.scene.n_particles  # type: ignore[union-attr]
        t = torch.linspace(0, self.end, 65, dtype=torch.float64)
        front = t + 4 * (1 + t) ** (1 / 3) + ahead
        if self.scene.boundary == "fixed":
            width = front.clamp(max=site - 1) + front.clamp(max=n - site) + 1
        else:
            width = (2 * front + 1).clamp(max=n)
        return float(width.mean())


# --------------------------------------------------------------------------------------------------------------- errors


def settle(method: str, facts: Facts, tolerance: float, dtype: torch.dtype) -> tuple[dict[str, Any], float]:
    """The coarsest options of a method that keep to the tolerance, and the error predicted for them."""
    options: dict[str, Any] = {}
    if method == "chebyshev":
        options = {"accuracy": max(1e-13, min(1e-4, tolerance / 20))}
    elif method == "dopri8":
        options = {"rtol": max(1e-13, min(1e-4, 0.5 * tolerance / _growth(facts)))}
    elif method in STEPPERS:
        order, _, _, limit = STEPPERS[method]
        step = min((0.9 * tolerance / _step_error(method, facts)) ** (1 / order), 0.7 * limit / facts.limit)
        if facts.scene.damping > 0:
            step = min(step, 0.7 / (facts.scene.damping * facts.limit**2))
        options = {"step": min(step, facts.end or 1.0)}
    return options, error_of(method, facts, options, dtype)


def error_of(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype) -> float:
    """Predicted error of a method, relative to the scale of the observables."""
    eps, phase = EPS[dtype], facts.limit * facts.end
    if method in STEPPERS:
        order, _, forces, _ = STEPPERS[method]
        walk = math.sqrt(forces * facts.end / options["step"])  # of the rounding errors of the steps
        return _step_error(method, facts) * options["step"] ** order + eps * (100 + 20 * walk) * facts.cancellation
    if method == "dopri8":
        return _growth(facts) * options["rtol"] + eps * (100 + 40 * phase)
    local = 5 * options.get("accuracy", 0.0)  # that of the whole state may lie where the state is small
    return local + eps * ((4000 if method == "damped" else 100) + 40 * phase)


def _step_error(method: str, facts: Facts) -> float:
    """Error per step^order: the phases' w^(order + 1) t where these matter, else the swing of the energy.

    Energies are off by twice what phases are, and the largest error of a field is larger than its mean.
    """
    order, constant, _, _ = STEPPERS[method]
    if facts.scene.observables == ("total_energy",) and facts.scene.damping == 0:
        return 18 * constant * facts.frequency(order)
    margin = 5 if "displacement" in facts.scene.observables else 3
    return margin * constant * facts.frequency(order + 1) * max(facts.growing, 1.0)


def _growth(facts: Facts) -> float:
    """Error of the adaptive method over its relative tolerance per step."""
    return 16 * max(1.0, facts.growing) * max(1.0, facts.frequency(1) / 2)


# ---------------------------------------------------------------------------------------------------------------- costs


def seconds(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    """Predicted wall time of a run: what every run takes, and the method's work spread over the cores."""
    kernels = method in ("chebyshev", *STEPPERS)
    cut = layout(facts.scene, method, facts.scene.observables, torch.device("cpu"))
    chunks, workers = math.ceil(facts.chains / cut.size), min(cut.workers, machine.cores)
    parallel = min(machine.cores, facts.rows) if facts.chains == 1 and kernels else 1
    rounds = math.ceil(chunks / workers) * min(cut.size, facts.chains)
    work = {
        "modes": _modes, "tridiagonal": _modes, "chebyshev": _chebyshev, "verlet": _steps, "symplectic4": _steps,
        "damped": _damped, "dopri8": _adaptive,
    }[method]  # fmt: skip
    each = work(method, facts, options, dtype, machine) / parallel
    each += facts.scene.n_particles * machine.draw
    if "long_time_band_energy" in facts.scene.observables:
        each += facts.rows * facts.n**2 * 4 * machine.entry
        if method != "modes":
            each += _decomposition("modes", facts.n, machine)
    once = machine.compilation or machine.loading * (not kernels_loaded()) if kernels else 0.0
    calls = CALLS[method] + 40 * len(facts.in_time) + 300 * (facts.reach is not None)
    python = (chunks * calls + facts.chains * CALLS["realization"]) * machine.call  # one thread's waits for the others'
    return machine.run + once + rounds * each + python


# Small operations of a chunk, and of a realization in the statistics: counted as time over that of one operation.
CALLS = {
    "modes": 1200, "tridiagonal": 1200, "chebyshev": 650, "verlet": 2100, "symplectic4": 2100, "damped": 2400,
    "dopri8": 2500, "realization": 100,
}  # fmt: skip


def _decomposition(method: str, n: int, machine: Machine) -> float:
    square, cube = (
        (machine.tridiagonal_square, machine.tridiagonal_cube)
        if method == "tridiagonal"
        else (machine.modes_square, machine.modes_cube)
    )
    return square * n**2 + cube * n**3


def _observing(facts: Facts, machine: Machine) -> float:
    """Observables of one chain from its states, transforms included, and their part in the statistics."""
    states = facts.rows * facts.count * facts.n
    passes = float(sum(PASSES[name] for name in facts.in_time))
    if facts.bands or "wavenumber_energy" in facts.scene.observables:
        passes += 8 * math.log2(facts.n)
    return states * passes * machine.entry


def _modes(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    n, states = facts.n, facts.rows * facts.count
    spent = _decomposition(method, n, machine) + 2 * facts.count * n * machine.trig
    if method == "modes" and facts.in_time == ["band_energy"] and facts.scene.energy_definition == "site":
        products = 3 if facts.scene.boundary == "periodic" and facts.scene.stiffness_disorder is None else 4
        binning = 4 * (facts.scene.n_bands + 1)
        spent += states * n * ((2 * products * n + binning) * machine.flop + 16 * machine.entry)
        return spent + 12 * n * n * math.log2(n) * machine.entry
    passes = 12 if facts.impulse else 6
    return spent + states * n * (4 * n * machine.flop + passes * machine.entry) + _observing(facts, machine)


def _chebyshev(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    accuracy = max(options["accuracy"], 1e-13)
    gaps = facts.gaps[facts.gaps > 0].tolist()
    fused = facts.fused()
    if facts.uniform:
        gaps, repeats = gaps[:1], len(gaps)
    else:
        repeats = 1
    stencils = sums = orders = 0.0
    longest = 4.0
    limit = facts.typical
    for gap in gaps:
        z = limit * gap
        leaps = math.ceil(z / LEAP)
        if leaps == 0:
            continue
        if z <= REACH and (facts.uniform or len(gaps) > 1):
            outputs = min(LONGEST, max(1, int(REACH / z)), len(gaps) * repeats)
        else:
            outputs = 1
        whole = terms(z / leaps if leaps > 1 else z * outputs, accuracy)
        mean = terms(z / leaps if leaps > 1 else z * (outputs + 1) / 2, accuracy)
        # An impulse has no displacement and a wave no velocity at first, and later the mirrored states may be at hand.
        mirrored = fused and facts.uniform and leaps == 1
        segments = len(gaps) * repeats * leaps / outputs
        both = 1.0 if mirrored else 2 - 1 / max(1.0, segments)
        stencils += repeats * leaps * both * whole / outputs
        sums += repeats * leaps * both * mean
        orders += 0 if mirrored else repeats * leaps * (z / leaps * outputs + 60)
        longest = max(longest, whole)
    cut = facts.reach is not None and facts.reach.pays(fused)
    whole_chain = facts.n if cut else facts.scene.n_particles
    if cut and fused:  # the check
        stencils, sums = (
            work + math.ceil(limit * facts.end / LEAP) * terms(LEAP, accuracy) for work in (stencils, sums)
        )
    size = facts.moving(longest / 2)
    spent = facts.rows * (size * (stencils * machine.stencil + sums * machine.sum) + orders * machine.order)
    spent += facts.rows * (stencils / 4 * machine.pass_call + whole_chain * machine.scratch)
    spent += whole_chain * machine.layout
    points = facts.rows * facts.count
    if not fused:
        return spent + points * facts.n * 2 * machine.entry + _observing(facts, machine)
    if facts.in_time == ["band_energy"]:
        return spent + points * facts.n * machine.transform
    return spent + points * size * machine.moment * bool(facts.in_time)


def _steps(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    forces = STEPPERS[method][2]
    count = float((facts.gaps / options["step"] * (1 - 1e-9)).ceil().sum())
    hertz, half = facts.scene.contact == "hertz", dtype == torch.float32
    update = machine.hertz if hertz else machine.update
    if half:
        update = machine.hertz_single if hertz else machine.update_single
    work = count * forces * (facts.n * update + machine.pass_call)
    if facts.scene.damping > 0:
        work += count * (facts.n * machine.damping + machine.pass_call)
    return facts.rows * (work + facts.count * facts.n * 4 * machine.entry) + _observing(facts, machine)


def _damped(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    n, states = facts.n, facts.rows * facts.count
    spent = machine.damped_square * n**2 + machine.damped_cube * n**3
    spent += states * n * (20 * n * machine.flop + 6 * machine.trig + 20 * machine.entry)
    return spent + _observing(facts, machine)


def _adaptive(method: str, facts: Facts, options: dict[str, Any], dtype: torch.dtype, machine: Machine) -> float:
    steps = 0.3 * facts.count + 0.27 * facts.end * options["rtol"] ** (-1 / 8)
    cut = layout(facts.scene, method, facts.scene.observables, torch.device("cpu"))
    calls = 120 * machine.call * min(cut.workers, machine.cores) / cut.size  # whose Python waits for the others'
    return steps * 13 * (calls + 400 * facts.rows * facts.n * machine.entry) + _observing(facts, machine)
