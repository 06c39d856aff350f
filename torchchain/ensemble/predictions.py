"""How far a way to run a scene will be off, by each method's own theory, and what it will cost on a nominal core."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from torchchain.chain.amplitude import elongation_estimate, force_deviation
from torchchain.chain.chain import Chain
from torchchain.chain.excitation import Impulse
from torchchain.chain.states import State
from torchchain.ensemble.lattice_facts import LatticeFacts
from torchchain.ensemble.moving_part import moving_part
from torchchain.ensemble.observables import chosen_observables, is_fused
from torchchain.ensemble.scene import Scene
from torchchain.evolvers import METHODS, Method
from torchchain.evolvers.expansion import LEAP, LONGEST, SHARED_PHASE, terms

EPS = {torch.float64: 2.0**-53, torch.float32: 2.0**-24}
SAMPLE = 2**17  # particles of the chains, and of the starts, that stand for the ensemble: some 20 ms
TAIL = 8  # of the softest and stiffest particles, from which those of chains not drawn are extrapolated


class Facts:
    """What the predictions need to know of a scene, from its first chains: all of them, where they are few.

    Attributes:
        n: particles that are computed.
        rows: starts per chain.
        chains: realizations that are computed, one where all are the same.
        typical: highest frequency of a chain, their mean.
        limit: frequency that no chain of the ensemble is expected to exceed.
        elongation, deviation: largest of the start, and of the Hertz force from the linear there.
        mean_elongation: the square root of the start's energy per particle.
        gaps: times from each output to the next, (time,).
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.part = moving_part(scene)
        inner = scene if self.part is None else self.part.scene(scene)
        self.n, self.rows, self.chains = inner.n_particles, max(1, len(scene.tones)), scene.distinct_realizations
        sampled = max(1, min(self.chains, SAMPLE // scene.n_particles))
        chain = scene.chain(range(sampled))
        if self.part is not None:
            chain = self.part.chain(chain)
        bounds = chain.squared_frequency_bound(sweeps=8).sqrt()
        few = max(1, SAMPLE // (self.rows * self.n))
        few = min(few, sampled)
        if self.part is None:
            self._linear: Chain = replace(scene.chain(range(few)), contact="linear", damping=0.0)
        else:
            self._linear = Chain(chain.masses[:few], inner.boundary, chain.contact_stiffness[:few])
        self._state = inner.state(self._linear)
        self.elongation = float(elongation_estimate(self._linear, self._state).max())
        self.deviation = float(force_deviation(torch.tensor(self.elongation, dtype=torch.float64)))
        energy = self._linear.energy(self._state.displacement, self._state.velocity)
        self.mean_elongation = float((energy / self.n).mean(0).max().sqrt())
        self.gaps = torch.cat([scene.times[:1], scene.times.diff()])
        self.end = float(scene.times[-1])
        self.typical = float(bounds.mean())
        self.limit = float(bounds.max()) * _growth_of_maximum(chain, self.chains / sampled)
        if scene.contact == "hertz":
            self.limit *= (1 + self.elongation) ** 0.25
        self._frequencies: dict[int, float] = {}
        self.impulse = isinstance(scene.excitation, Impulse)
        later = self.gaps[self.gaps > 0]
        self.uniform = len(later) > 0 and bool((later - later[0]).abs().max() <= 1e-9 * self.end)
        self.observables = chosen_observables(scene.observables)

    @property
    def accumulated(self) -> float:
        """What leaving out the nonlinearity of Hertz contacts does to energies by the last time.

        The force is off by ``deviation``, and phases by half of that times w t while the elongation lasts. A pulse
        spreads: its elongation starts at about half and falls as t^(-1/3), the front's, down to what disorder localizes,
        and no particle has more than a tenth of its energy again.
        """
        w = min(self.frequency(1), self.typical)
        lasting = self.end
        if self.impulse:
            kinds = self.scene.disorder, self.scene.stiffness_disorder
            mixed = 0.0 if self.scene.mixture is None else self.scene.mixture.spread
            localized = min(1.0, max(mixed, *(kind.strength for kind in kinds if kind is not None), 0.0))
            lasting = 0.05 * max(1.5 * ((1 + self.end) ** (2 / 3) - 1), localized * self.end)
        return self.deviation * (1 + 0.5 * w * lasting)

    def frequency(self, power: int) -> float:
        """The mean of w^power over the start, in the norm of the energy: |G^power x| / |x|, with dx/dt = G x.

        The shares of the modes never change in a linear chain, so that this is what a phase error in w^power does
        at all times. A wave in Hertz contacts makes harmonics, in the end at all frequencies alike.
        """
        if power not in self._frequencies:
            mean = _mean_power(self._linear, self._state, power)
            if self.scene.contact == "hertz":
                harmonics = min(1.0, self.deviation * self.end * mean ** (1 / power))
                mean = max(mean, 2 * harmonics * _mean_power(self._linear, _white(self._linear), power))
                mean *= (1 + self.elongation) ** (power / 4)
            self._frequencies[power] = mean
        return self._frequencies[power]

    @property
    def cancellation(self) -> float:
        """How much larger displacements are than elongations, whose rounding errors they bring: beyond tenfold.

        A wave of small k has 1 / k; a ring that is struck moves on as a whole, by v t / N against some v / sqrt(N).
        """
        largest = float(self._state.displacement.abs().max()) / (10 * self.elongation)
        whole = self.end / math.sqrt(self.n) if self.impulse and self.scene.boundary == "periodic" else 0.0
        return max(1.0, largest, whole)

    @property
    def growing(self) -> float:
        """The time over which phase errors grow: damping ends that of the fast modes."""
        return self.end if self.scene.largest_damping == 0 else min(self.end, 1 / self.scene.largest_damping)

    @property
    def bands_alone(self) -> bool:
        """Whether band energies are all that is measured in time."""
        return {entry.kernel for entry in self.observables if entry.in_time} == {"bands"}

    def moving(self, ahead: float = 0.0) -> float:
        """Mean over time of the particles that the stencil touches, ``ahead`` beyond those that move."""
        if not isinstance(self.scene.excitation, Impulse):
            return float(self.n)
        site, n = self.scene.excitation.site, self.scene.n_particles
        t = torch.linspace(0, self.end, 65, dtype=torch.float64)
        front = t + 4 * (1 + t) ** (1 / 3) + ahead
        if self.scene.boundary == "fixed":
            width = front.clamp(max=site - 1) + front.clamp(max=n - site) + 1
        else:
            width = (2 * front + 1).clamp(max=n)
        return float(width.mean())


def _growth_of_maximum(chain: Chain, more: float) -> float:
    """By how much the highest frequency of so many times more chains exceeds that of these.

    The tail of Gershgorin's bound 2 (kappa + kappa') / m over the particles, as a power law (Hill 1975).
    """
    if more <= 1:
        return 1.0
    stiffness = chain.contact_stiffness
    right = stiffness.roll(-1, -1) if chain.boundary == "periodic" else stiffness[..., 1:]
    local = ((stiffness[..., : chain.n_particles] + right) / chain.masses).flatten()
    top = local.topk(min(TAIL, len(local))).values.log()
    return 1.1 * float(torch.exp((top - top[-1]).mean() * math.log(more) / 2))


def _white(chain: Chain) -> State:
    """A start in which all modes have the same energy on average: velocities of random signs, kinetic energies alike."""
    signs = torch.randint(0, 2, chain.masses.shape, generator=torch.Generator().manual_seed(0)) * 2 - 1
    return State(torch.zeros_like(chain.masses), signs / chain.masses.sqrt())


def _mean_power(chain: Chain, state: State, power: int) -> float:
    first = chain.energy(state.displacement, state.velocity)
    for _ in range(power):
        force = chain.force(state.displacement)
        state = State(state.velocity, force / chain.align(chain.masses, force))
    return float((chain.energy(state.displacement, state.velocity) / first).mean(0).max().sqrt())


# --------------------------------------------------------------------------------------------------------------- errors


def facts_of(scene: Scene) -> Facts | LatticeFacts:
    """What the predictions need to know of a scene."""
    return Facts(scene) if scene.lattice is None else LatticeFacts(scene)


def settle(
    method: str, facts: Facts | LatticeFacts, tolerance: float, dtype: torch.dtype
) -> tuple[dict[str, Any], float]:
    """The coarsest options of a method that keep to the tolerance, and the error predicted for them."""
    if isinstance(facts, LatticeFacts):
        return facts.settle(method, tolerance)
    entry, options = METHODS[method], {}
    if "accuracy" in entry.options:
        options = {"accuracy": max(1e-13, min(1e-4, tolerance / 20))}
    elif "rtol" in entry.options:
        options = {"rtol": max(1e-13, min(1e-4, 0.5 * tolerance / _adaptive_growth(facts)))}
    elif entry.order_in_step is not None:
        step = (0.9 * tolerance / _step_error(entry, facts)) ** (1 / entry.order_in_step)
        step = min(step, 0.7 * (entry.stability_limit or math.inf) / facts.limit)
        if facts.scene.largest_damping > 0:
            step = min(step, 0.7 / (facts.scene.largest_damping * facts.limit**2))
        options = {"step": min(step, facts.end or 1.0)}
    return options, error_of(method, facts, options, dtype)


def error_of(method: str, facts: Facts | LatticeFacts, options: dict[str, Any], dtype: torch.dtype) -> float:
    """Predicted error of a method, relative to the scale of the observables."""
    if isinstance(facts, LatticeFacts):
        return facts.error_of(method, options)
    entry, eps, phase = METHODS[method], EPS[dtype], facts.limit * facts.end
    if entry.order_in_step is not None:
        walk = math.sqrt(entry.forces_per_step * facts.end / options["step"])  # of the rounding errors of the steps
        truncation = _step_error(entry, facts) * options["step"] ** entry.order_in_step
        return truncation + eps * (100 + 20 * walk) * facts.cancellation
    if "rtol" in entry.options:
        return _adaptive_growth(facts) * options["rtol"] + eps * (100 + 40 * phase)
    local = 5 * options.get("accuracy", 0.0)  # that of the whole state may lie where the state is small
    return local + eps * (100 * max(1, entry.matrices) + 40 * phase)


def _step_error(entry: Method, facts: Facts) -> float:
    """Error per step^order: the phases' w^(order + 1) t where these matter, else the swing of the energy.

    Energies are off by twice what phases are, and the largest error of a field is larger than its mean.
    """
    assert entry.order_in_step is not None
    if facts.scene.observables == ("total_energy",) and facts.scene.largest_damping == 0:
        swing = 6 * entry.phase_error if math.isnan(entry.energy_error) else entry.energy_error
        return 3 * swing * facts.frequency(entry.order_in_step // 2) ** 2  # modes' energies add, with their weights
    margin = 5 if "displacement" in facts.scene.observables else 3
    # Energies swing with the first step, as far as phases take these times to err: 8 for symplectic4, chosen on Hertz chains.
    swinging = 0.0 if math.isnan(entry.energy_error) else entry.energy_error / (7 * entry.phase_error)
    return margin * entry.phase_error * facts.frequency(entry.order_in_step + 1) * max(facts.growing, swinging, 3.0)


def _adaptive_growth(facts: Facts) -> float:
    """Error of the adaptive method over its relative tolerance per step."""
    return 16 * max(1.0, facts.growing) * max(1.0, facts.frequency(1) / 2)


# ---------------------------------------------------------------------------------------------------------------- costs

# Seconds on one core of a 2023 server (AMD EPYC). They rank the methods, the same on every machine; what a run takes here
# is told by these times one measured ratio, see plan.speed.
CALL = 1.0e-6  # one operation on a small tensor
PASS = 2.6e-10  # an elementwise pass, per number
FLOP = 2.1e-11  # of a product of matrices
TRIG = 3.0e-9  # a cosine
DRAW = 2.6e-8  # a particle
STENCIL, SUM, MOMENT, TRANSFORM, BESSEL, START = (
    2.2e-10,
    1.2e-10,
    5.0e-10,
    6.0e-9,
    5.2e-9,
    1.9e-7,
)  # kernels, per particle
UPDATE = {"linear": (4.6e-10, 2.9e-10), "hertz": (1.3e-9, 5.3e-10)}  # drift and kick of a particle: float64, float32
DAMP, LOOP = 1.2e-9, 2.9e-8  # contact damping over a step, per particle; starting a loop over a chain
CALLS = 1200  # small operations of a chunk of chains


def cost(method: str, facts: Facts | LatticeFacts, options: dict[str, Any], dtype: torch.dtype, chunk: int) -> float:
    """Seconds of a chain or lattice on one nominal core, in chunks of so many."""
    if isinstance(facts, LatticeFacts):
        return facts.cost(method, options)
    entry, n = METHODS[method], facts.n
    if "accuracy" in entry.options:
        seconds = _chebyshev(facts, options["accuracy"])
    elif "rtol" in entry.options:
        steps = 0.3 * len(facts.gaps) + 0.27 * facts.end * options["rtol"] ** (-1 / 8)
        seconds = steps * 13 * (120 * CALL / chunk + 400 * facts.rows * n * PASS) + _observing(facts)
    elif entry.order_in_step is not None:
        seconds = _steps(entry, facts, options["step"], dtype)
    else:
        seconds = _decomposed(entry, facts)
    if any(not observable.in_time for observable in facts.observables):
        seconds += 4 * facts.rows * n**2 * PASS + (_decomposition(METHODS["modes"], n) if method != "modes" else 0.0)
    calls = CALLS + 40 * len(facts.observables) + 300 * (facts.part is not None)
    return seconds + facts.scene.n_particles * DRAW + (calls / chunk + 100) * CALL


def _decomposition(entry: Method, n: int) -> float:
    square, cube = entry.decomposition
    return square * n**2 + cube * n**3


def _observing(facts: Facts) -> float:
    """Observables of one chain from its states, transforms included, and their part in the statistics."""
    passes = sum(observable.passes for observable in facts.observables if observable.in_time)
    if any(observable.wavenumbers for observable in facts.observables):
        passes += 8 * math.log2(facts.n)
    return facts.rows * len(facts.gaps) * facts.n * passes * PASS


def _decomposed(entry: Method, facts: Facts) -> float:
    n, count = facts.n, len(facts.gaps)
    states = facts.rows * count * n
    seconds = _decomposition(entry, n) + 2 * count * n * TRIG
    if entry.damped:
        return seconds + states * (20 * n * FLOP + 6 * TRIG + 20 * PASS) + _observing(facts)
    if entry.name == "modes" and facts.bands_alone and facts.scene.energy_definition == "site":
        products = 3 if facts.scene.boundary == "periodic" and facts.scene.stiffness_disorder is None else 4
        seconds += states * ((2 * products * n + 4 * (facts.scene.n_bands + 1)) * FLOP + 16 * PASS)
        return seconds + 12 * n * n * math.log2(n) * PASS
    passes = 12 if facts.impulse else 6
    return seconds + states * (4 * n * FLOP + passes * PASS) + _observing(facts)


def _steps(entry: Method, facts: Facts, step: float, dtype: torch.dtype) -> float:
    count = float((facts.gaps / step * (1 - 1e-9)).ceil().sum())
    update = UPDATE[facts.scene.contact][dtype == torch.float32]
    work = count * entry.forces_per_step * (facts.n * update + LOOP)
    if facts.scene.largest_damping > 0:
        work += count * (facts.n * DAMP + LOOP)
    return facts.rows * (work + len(facts.gaps) * facts.n * 4 * PASS) + _observing(facts)


def _chebyshev(facts: Facts, accuracy: float) -> float:
    """Counted stencils, sums and Bessel functions of the segments that the times are cut into."""
    gaps, points = facts.gaps[facts.gaps > 0], facts.rows * len(facts.gaps)
    z = facts.typical * (gaps[:1] if facts.uniform else gaps)  # one stands for all that are equal
    repeats = len(gaps) if facts.uniform else 1
    fused = is_fused("chebyshev", facts.scene)
    stencils = sums = orders = 0.0
    longest = 4.0
    for phase in z.tolist():
        leaps = math.ceil(phase / LEAP)
        shared = phase <= SHARED_PHASE and len(gaps) > 1
        outputs = min(LONGEST, max(1, int(SHARED_PHASE / phase)), len(gaps)) if shared else 1
        whole = terms(phase / leaps if leaps > 1 else phase * outputs, accuracy)
        mean = terms(phase / leaps if leaps > 1 else phase * (outputs + 1) / 2, accuracy)
        # An impulse has no displacement and a wave no velocity at first, and later the mirrored states may be at hand.
        mirrored = fused and facts.uniform and leaps == 1
        both = 1.0 if mirrored else 2 - 1 / max(1.0, len(gaps) * leaps / outputs)
        stencils += repeats * leaps * both * whole / outputs
        sums += repeats * leaps * both * mean
        orders += 0 if mirrored else repeats * leaps * (phase / leaps * outputs + 60)
        longest = max(longest, whole)
    part = moving_part(facts.scene, "chebyshev")
    whole_chain = facts.scene.n_particles if part is None else part.size
    if part is not None and fused:  # the check
        check = math.ceil(facts.typical * facts.end / LEAP) * terms(LEAP, accuracy)
        stencils, sums = stencils + check, sums + check
    size = facts.moving(longest / 2)
    seconds = facts.rows * (size * (stencils * STENCIL + sums * SUM) + orders * BESSEL + stencils / 4 * LOOP)
    seconds += whole_chain * START * (0.75 + 0.25 * facts.rows)
    if not fused:
        return seconds + points * facts.n * 2 * PASS + _observing(facts)
    measured = [entry for entry in facts.observables if entry.in_time]
    if any(entry.bands for entry in measured):
        return seconds + points * facts.n * TRANSFORM * (4 / 3 if len(measured) > 1 else 1)  # of four fields, not three
    return seconds + points * size * MOMENT * bool(measured)
