"""Where every method fails: the edge that theory predicts, the edge found by bisection, and what the library says beyond."""

from __future__ import annotations

import math
import sys
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import harness
import numpy as np
import torch
import torchdiffeq
import xarray
from harness import Row
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import optimize, special
from theory import FAILS, outline
from torch import Tensor

import torchchain as tc
from torchchain import checks, plots
from torchchain.ensemble.scene_file import regular_times
from torchchain.evolvers import chebyshev, ode, symplectic
from torchchain.evolvers.compositions import PEFRL, VERLET
from torchchain.master import Calibration
from torchchain.master.solving import ADAMS_ITERATIONS, ADAMS_STEPS, STABILITY

EPS, EPS32 = torch.finfo(torch.float64).eps, torch.finfo(torch.float32).eps
BLOWN_UP = 1e3
RIGHT = "is right: the idealization is not"
ITERATED = ("implicit_adams", "fixed_adams")
STEPS = 1500  # of a step tried for stability: 1e-4 beyond the edge is found


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """seed of the random starts and chains"""
    halvings: int = 16
    """bisections of every bracket"""
    points: int = 25
    """values at which every badness is drawn"""
    n_particles: int = 256
    """particles of the rings that the theory of disorder is held against"""
    n_bands: int = 32
    """bands of them"""
    realizations: int = 400
    """rings"""
    strengths: tuple[float, ...] = (0.1, 0.2, 0.3, 0.5)
    """their disorders xi, normal masses"""
    binary: tuple[float, ...] = (0.5,)
    """the same, binary masses"""
    step: float = 4.0
    """time step"""
    stop: float = 200.0
    """last time"""


SMOKE = Config(
    halvings=2, points=2, n_particles=32, n_bands=4, realizations=4, strengths=(0.3,), binary=(0.5,), stop=16.0
)


@dataclass(frozen=True)
class Edge:
    """One way for a method to fail.

    Attributes:
        method: that fails.
        quantity: what grows until it fails.
        predicted: its value at the edge.
        theory: where the prediction comes from.
        factor: by which found and predicted may differ: how sharp theory and edge are.
        badness: what goes wrong at a value, by the method's own step without any guard; not a number counts as wrong.
        limit: of the badness.
        bracket: the search's first and last value over the predicted one.
        public: the same through the library's front door; None where what fails is an idealization and the library is right.
    """

    method: str
    quantity: str
    predicted: float
    theory: str
    factor: float
    badness: Callable[[float], float]
    limit: float
    bracket: tuple[float, float]
    public: Callable[[float], Any] | None

    @property
    def name(self) -> str:
        return f"{self.method}: {self.quantity}"

    def holds(self, value: float) -> bool:
        return self.badness(value) <= self.limit


def found(edge: Edge, halvings: int) -> float:
    """The edge by bisection, on a logarithmic scale; not a number if the bracket does not hold one."""
    low, high = (edge.predicted * end for end in edge.bracket)
    if not edge.holds(low) or edge.holds(high):
        return math.nan
    for _ in range(halvings):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if edge.holds(middle) else (low, middle)
    return math.sqrt(low * high)


def beyond(edge: Edge, place: float) -> float:
    """A value clearly beyond the edge."""
    return 1.1 * (edge.predicted if math.isnan(place) else max(edge.predicted, place))


def answer(call: Callable[[float], Any], value: float) -> str:
    """What the library says: its error or its warnings, or nothing."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            call(value)
        except (ValueError, RuntimeError) as error:
            return f"{type(error).__name__}: {error}"
    return "; ".join(f"{entry.category.__name__}: {entry.message}" for entry in caught)


def edges(seed: int) -> list[Edge]:
    """Every edge, with chains and starts from the seed."""
    return [
        *_symplectic(seed),
        _chebyshev_bound(seed),
        *_oscillator_steps(),
        *_drifting_steps(),
        *_decay_steps(),
        *_stiff_rates(),
        *_overflow(),
        _long_exponential(),
        _phases(seed),
        _mass_ratio(),
        *_finite_chains(),
        _open_contacts(),
        *_hertz_waves(),
    ]


def zigzag(n: int = 16) -> tuple[tc.Chain, tc.State]:
    """An ordered ring in its fastest mode, w = 2, with a trace of all others."""
    chain = tc.Chain(torch.ones(n, dtype=torch.float64))
    noise = torch.randn(n, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    fastest = tc.standing_wave(chain, n // 2, 0.01, "cos").displacement
    return chain, tc.State(fastest + 1e-4 * (noise - noise.mean()), torch.zeros_like(noise))


def _symplectic(seed: int) -> list[Edge]:
    chain, state = zigzag()

    def growth(composition: symplectic.Composition, value: float) -> float:
        h = value / 2
        trajectory = symplectic.stepping(chain, state, composition, h * (1 + 1e-9))(torch.tensor([h * STEPS]))
        return float(trajectory.displacement.abs().max() / 0.01)

    def public(method: str, value: float) -> tc.Trajectory:
        return tc.evolve(chain, state, [10.0], method, step=value / 2)

    return [
        Edge(name, "w_max step", limit, theory, 1.01, partial(growth, composition), BLOWN_UP, (0.7, 1.4), partial(public, name))
        for name, composition, limit, theory in (
            ("verlet", VERLET, 2.0, "trace 2 - (w h)^2 of a step leaves [-2, 2]"),
            ("symplectic4", PEFRL, 2.98944, "trace of a step first leaves [-2, 2]"),
        )
    ]  # fmt: skip


def _chebyshev_bound(seed: int) -> Edge:
    """T_k grows beyond [-1, 1]; to a point the terms beyond z / 2 that vanish make up for it."""
    chain = tc.Chain(tc.Disorder().masses(64, 1, seed)[0])
    modes = tc.normal_modes(chain)
    highest = float(modes.frequencies[-1])
    state = tc.State(0.01 * modes.shapes[:, -1], torch.zeros(64, dtype=torch.float64))
    times = torch.tensor([500.0])
    exact = math.cos(highest * 500.0)

    def error(value: float) -> float:
        frequency = torch.tensor(highest / math.sqrt(value), dtype=torch.float64)
        found = chebyshev.expanded(chain, state, frequency, 1e-15, tc.Trajectory)(times).displacement[0]
        return float((found / 0.01 - exact * modes.shapes[:, -1]).abs().max())

    return Edge(
        "chebyshev", "w_max^2 / bound", 1.0, "|T_k(x)| <= 1 only on [-1, 1]", 1.02, error, 1e-6, (0.9, 1.3),
        lambda value: tc.evolve(chain, state, [500.0], "chebyshev", bound=highest**2 / value),
    )  # fmt: skip


def _fixed_steps(
    method: str,
    slope: Callable[[Tensor, Tensor], Tensor],
    start: Tensor,
    h: float,
    steps: int,
    adams: int = ADAMS_STEPS,
) -> Tensor:
    """A number of steps by torchdiffeq with the options that the library gives it."""
    options: dict[str, Any] = {"step_size": h}
    if method.endswith("adams"):
        options |= {"max_order": adams, "max_iters": ADAMS_ITERATIONS}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*iteration did not converge.*")
        grid = torch.tensor([0.0, h * steps], dtype=torch.float64)
        return torchdiffeq.odeint(slope, start, grid, rtol=1e-6, atol=1e-8, method=method, options=options)[-1]


def steps(method: str) -> int:
    """How many show an edge to 1 %: a multistep method's parasitic root starts from little."""
    return 30 if method in ITERATED else 1200 if method == "explicit_adams" else 300


def _oscillator_steps() -> list[Edge]:
    """Solvers of torchdiffeq on a single oscillator, w = 1."""
    chain, state = zigzag()
    adams = next(solver for solver in ode.FIXED if solver.name == "explicit_adams").options["max_order"]

    def growth(method: str, value: float) -> float:
        start = torch.tensor([1.0, 0.0], dtype=torch.float64)
        matrix = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
        return float(_fixed_steps(method, lambda t, y: y @ matrix, start, value, steps(method), adams).norm())

    def public(method: str, value: float) -> tc.Trajectory:
        return tc.evolve(chain, state, [10.0], method, step=value / 2)

    return [
        Edge(method, "w_max step", predicted, theory, 1.01, partial(growth, method), 1.01, (0.7, 1.4), partial(public, method))
        for method, predicted, theory in (
            ("heun3", math.sqrt(3), "|1 + z + z^2/2 + z^3/6| = 1 on the imaginary axis"),
            ("rk4", math.sqrt(8), "|1 + z + z^2/2 + z^3/6 + z^4/24| = 1 on the imaginary axis"),
            ("explicit_adams", _adams_limit(ADAMS4, 1j), "a root of Adams and Bashforth's polynomial leaves the unit circle"),
        )
    ]  # fmt: skip


ADAMS3, ADAMS4 = np.array([23, -16, 5]) / 12, np.array([55, -59, 37, -9]) / 24


def _adams_limit(weights: np.ndarray, direction: complex) -> float:
    """Where a root of y_n+1 = y_n + z (weights . past) leaves the unit circle, z = limit * direction."""

    def excess(size: float) -> float:
        polynomial = np.concatenate([[1.0, -1.0], np.zeros(len(weights) - 1)]).astype(complex)
        polynomial[1:] -= size * direction * weights
        return float(np.abs(np.roots(polynomial)).max()) - 1 - 1e-6

    return optimize.brentq(excess, 0.1, 2.0)


def _drifting_steps() -> list[Edge]:
    """Methods that no step makes stable: the energy of a mode grows by 1 + (w h)^4 / 4 at every step."""
    chain, state = zigzag()
    h = 0.15

    def gain(method: str, value: float) -> float:
        steps = max(1, round(value / h))
        matrix = torch.tensor([[0.0, -2.0], [2.0, 0.0]], dtype=torch.float64)
        start = torch.tensor([1.0, 0.0], dtype=torch.float64)
        return float(_fixed_steps(method, lambda t, y: y @ matrix, start, h, steps).square().sum() - 1)

    predicted = math.log(1.1) / math.log1p((2 * h) ** 4 / 4) * h
    return [
        Edge(method, "time until the energy is off by 10 %, w step = 0.3", predicted, "|1 + z + z^2/2|^2 = 1 + (w h)^4 / 4", 1.03,
             partial(gain, method), 0.1, (0.5, 2.0), lambda value, m=method: tc.evolve(chain, state, [value], m, step=h))
        for method in ("midpoint", "heun2")
    ]  # fmt: skip


def master(rates: Tensor, damping: Tensor | None = None) -> tc.MasterEquation:
    """A master equation of given rates, nothing of which stays where it is."""
    scene = tc.Scene(n_particles=8 * len(rates), n_bands=len(rates), realizations=2)
    model = tc.RateModel(rates, torch.zeros_like(rates[0]), damping)
    return tc.MasterEquation(model, Calibration("linear", "paper", None, scene))


def exchange(rate: float) -> Tensor:
    """Two bands that share their energy: eigenvalues 0 and -rate."""
    return rate / 2 * torch.tensor([[-1.0, 1.0], [1.0, -1.0]], dtype=torch.float64)


def _decay_steps() -> list[Edge]:
    """Fixed-step solvers of the master equation on one decay, dy/dt = -y."""
    first = torch.tensor([1.0, 0.0], dtype=torch.float64)

    def growth(method: str, value: float) -> float:
        return float(_fixed_steps(method, lambda t, y: -y, first[:1], value, steps(method)).abs())

    def public(method: str, value: float) -> Tensor:
        return master(exchange(1.0)).solve(first, [value * 20], method, step=value)

    corrector = "fixed-point iteration contracts by 3/8 |lambda| h: the library stops well before 8/3"
    found = []
    for method, predicted in STABILITY.items():
        theory, sharp = "|1 + z + ... + z^p / p!| = 1 on the real axis", 1.01
        if method == "explicit_adams":
            predicted, theory = (
                _adams_limit(ADAMS3, -1),
                "a root of Adams and Bashforth's polynomial leaves the unit circle",
            )
        elif method in ITERATED:
            predicted, theory, sharp = 8 / 3, corrector, 1.2
        found.append(
            Edge(
                method,
                "|lambda| step",
                predicted,
                theory,
                sharp,
                partial(growth, method),
                1.0,
                (0.5, 1.6),
                partial(public, method),
            )
        )
    return found


def _stiff_rates() -> list[Edge]:
    """Explicit adaptive solvers after the fast part has died out: their steps stay at the stability limit."""
    allowed = 50
    rates = torch.tensor([[-1.0, 1.0], [0.0, 0.0]], dtype=torch.float64)

    def taken(method: str, value: float) -> float:
        count = 0

        class Slope(torch.nn.Module):
            def forward(self, t: Tensor, y: Tensor) -> Tensor:
                return y @ rates

            def callback_accept_step(self, *_: Any) -> None:
                nonlocal count
                count += 1

        grid = torch.tensor([0.0, value], dtype=torch.float64)
        start = torch.tensor([1.0, 0.0], dtype=torch.float64)
        torchdiffeq.odeint(Slope(), start, grid, rtol=1e-3, atol=1e-4, method=method)
        return count

    return [
        Edge(method, f"|lambda| t in {allowed} steps", reach * allowed, f"{allowed} steps of the stability limit {reach:.3g} / |lambda|",
             1.6, partial(taken, method), allowed, (0.4, 2.5), partial(_too_many_steps, method))
        for method, reach in (("dopri5", 3.3066), ("bosh3", 2.5127), ("fehlberg2", 2.0))
    ]  # fmt: skip


def _too_many_steps(method: str, value: float) -> Tensor:
    """As stiff a master equation, where the library is made to allow 50 steps."""
    from torchchain.master import solving

    allowed, solving.MOST_STEPS = solving.MOST_STEPS, 50
    try:
        options = {"rtol": 1e-3, "atol": 1e-4}
        return master(exchange(1.0)).solve(torch.tensor([1.0, 0.0]), [value], method, **options)
    finally:
        solving.MOST_STEPS = allowed


def _overflow() -> list[Edge]:
    """Rates whose rows sum to g > 0 make energy, exp(g t), up to the largest number."""
    g = 0.5
    found = []
    for dtype in (torch.float32, torch.float64):
        rates = (exchange(1.0) + g * torch.eye(2)).to(dtype)
        start = torch.tensor([1.0, 0.0], dtype=dtype)
        last = (math.log(2) + math.log(torch.finfo(dtype).max)) / g

        def size(value: float, rates: Tensor = rates, start: Tensor = start) -> float:
            half = torch.linalg.matrix_exp(rates * (value / 2))
            return float((start @ half @ half).max())

        def public(value: float, rates: Tensor = rates, start: Tensor = start) -> Tensor:
            return master(rates).solve(start, [value])

        name = str(dtype).removeprefix("torch.")
        found.append(
            Edge("leaking rates", f"time to overflow, {name}", last, "exp(g t) / 2 reaches the largest number", 1.01, size,
                 torch.finfo(dtype).max, (0.5, 2.0), public)
        )  # fmt: skip
    return found


def _long_exponential() -> Edge:
    """Scaling and squaring: the rounding of Q t is carried on by every square."""
    rates = torch.tensor([[-1.0, 0.6, 0.4], [0.5, -0.8, 0.3], [0.2, 0.7, -0.9]], dtype=torch.float64) / 2
    start = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)

    def error(value: float) -> float:
        return abs(float((start @ torch.linalg.matrix_exp(rates * value)).sum()) - 1)

    return Edge(
        "expm", "|Q| t", 1e-6 / EPS, "rounding of 1 grows as eps |Q| t; 1e-6 is too much", 10.0, error, 1e-6, (1e-3, 1e4),
        lambda value: master(rates).solve(start, [value]),
    )  # fmt: skip


def _phases(seed: int) -> Edge:
    """Single precision: each frequency is off by some eps of the highest, and phases by that times t.

    How each rounds depends on the processor, its libraries and threads: states are off by 1 to 15 times w_max t eps, so
    that the edge is known to a factor of four either way, and is given twice that.
    """
    masses = tc.Disorder().masses(256, 1, seed)[0].float()
    exact, rounded = tc.Chain(masses.double()), tc.Chain(masses)
    modes, modes32 = tc.normal_modes(exact), tc.normal_modes(rounded)
    noise = 0.01 * torch.randn(256, generator=torch.Generator().manual_seed(seed))
    state32 = tc.State(noise, torch.zeros_like(noise))
    state = tc.State(noise.double(), torch.zeros(256, dtype=torch.float64))
    amplitude = (exact.masses * state.displacement) @ modes.shapes
    amplitude32 = (rounded.masses * state32.displacement) @ modes32.shapes
    blur = float(modes.frequencies[-1]) * torch.finfo(torch.float32).eps

    def error(value: float) -> float:  # Eq. 20 as it stands
        t = torch.tensor(value, dtype=torch.float32)
        blurred = modes32.shapes @ ((modes32.frequencies * t).cos() * amplitude32)
        exactly = modes.shapes @ ((modes.frequencies * t.double()).cos() * amplitude)
        return float((blurred.double() - exactly).norm() / exactly.norm())

    return Edge(
        "modes, float32", "time until states are off by 10 %", 0.1 / (15**0.5 * blur),
        "error 1 to 15 times w_max t eps", 8.0, error, 0.1, (1 / 16, 16), lambda value: tc.evolve(rounded, state32, [value], "modes"),
    )  # fmt: skip


def _mass_ratio() -> Edge:
    """A very light and a very heavy particle: the solver knows w^2 to eps of the highest only."""

    def chain_of(ratio: float) -> tc.Chain:
        masses = torch.ones(64, dtype=torch.float64)
        masses[20], masses[40] = ratio**-0.5, ratio**0.5
        return tc.Chain(masses, "fixed")

    def error(value: float) -> float:
        chain = chain_of(value)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            energy = tc.total_energy(chain, tc.evolve(chain, tc.impulse(chain, 10), [50.0], "modes"))
        return float((energy / 0.5e-4 - 1).abs().max())

    return Edge(
        "modes", "mass ratio for energy to 1e-8", (1e-8 / EPS) ** 2, "error eps sqrt(ratio), w_max^2 growing so", 30.0, error, 1e-8,
        (1e-8, 1e3), lambda value: tc.evolve(chain := chain_of(value), tc.impulse(chain, 10), [50.0], "modes"),
    )  # fmt: skip


def _finite_chains() -> list[Edge]:
    """A chain is not infinite from when its wave has come around, or back from the wall (Bessel functions of images)."""
    n, limit = 128, 1e-3
    ring, fixed = (tc.Chain(torch.ones(n, dtype=torch.float64), boundary) for boundary in ("periodic", "fixed"))

    def around(value: float) -> float:
        velocity = tc.evolve(ring, tc.impulse(ring, 1, 0.01), [value], "chebyshev").velocity[0, 0]
        return abs(float(velocity) / 0.01 - special.jv(0, 2 * value))

    def reflected(value: float) -> float:
        velocity = tc.evolve(fixed, tc.impulse(fixed, 1, 0.01), [value], "chebyshev").velocity[0, -1]
        return abs(float(velocity) / 0.01 - special.jv(2 * n - 2, 2 * value) + special.jv(2 * n + 2, 2 * value))

    images = (
        lambda t: abs(2 * special.jv(2 * n, 2 * t)),
        lambda t: abs(special.jv(2 * (n + 1), 2 * t) - special.jv(2 * (n + 3), 2 * t)),
    )
    first = [optimize.brentq(lambda t, image=image: image(t) - limit, 0.7 * n, n) for image in images]
    return [
        Edge("periodic chain as infinite", "time until it differs by 0.001", first[0],
             f"first image, 2 J_2N(2 t): {first[0] / n:.3f} N", 1.01, around, limit, (0.8, 1.02), None),
        Edge("fixed chain as half infinite", "time until it differs by 0.001", first[1],
             f"first image behind the far wall: {first[1] / n:.3f} N", 1.01, reflected, limit, (0.8, 1.02), None),
    ]  # fmt: skip


def _open_contacts() -> Edge:
    """Linear contacts pull where real ones have opened: elongation 2 a sin(k / 2) of a standing wave."""
    n, tone = 64, 5
    chain = tc.Chain(torch.ones(n, dtype=torch.float64))
    k = 2 * math.pi * tone / n

    def stretch(value: float) -> float:
        wave = tc.standing_wave(chain, tone, value)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            trajectory = tc.evolve(chain, wave, torch.linspace(0, 40, 81, dtype=torch.float64))
        return float(tc.linearity(chain, trajectory).stretch.max())

    def public(value: float) -> xarray.Dataset:
        wave = tc.StandingWave(tones=(tone,), amplitude=value)
        return tc.simulate(tc.Scene(n, disorder=tc.Disorder(strength=0), excitation=wave, times=[0.0, 1.0], n_bands=4))

    return Edge(
        "linear contacts", "amplitude", 1 / (2 * math.sin(k / 2)), "a contact opens at elongation 2 a sin(k / 2) = 1", 1.01,
        stretch, 1.0, (0.5, 2.0), public,
    )  # fmt: skip


def _hertz_waves() -> list[Edge]:
    """Traveling waves in an ordered Hertz chain: where they are no longer linear, and where no longer of second order.

    The second harmonic beats up to (A^2 / 4) cot(k / 2), of the energy (2 cos(k / 2) cot(k / 2) A / 4)^2; the expansion in the
    elongation ends where a contact opens, 2 A sin(k / 2) = 1 if it did not steepen.
    """
    n, tone = 64, 5
    k = 2 * math.pi * tone / n
    chain = tc.Chain(torch.ones(n, dtype=torch.float64), contact="hertz")
    phase = k * torch.arange(n, dtype=torch.float64)
    beat = 4 * math.sin(k / 2) * (1 - math.cos(k / 2))

    def path(value: float, times: Tensor) -> tc.Trajectory:
        start = tc.State(value * phase.cos(), value * 2 * math.sin(k / 2) * phase.sin())
        return tc.evolve(chain, start, times, "symplectic4", step=0.1)

    def harmonic(value: float) -> float:
        motion = path(value, torch.tensor([math.pi / beat], dtype=torch.float64))
        double = 2 * math.sin(k)
        wave, speed = (torch.fft.fft(x[0])[2 * tone] / n for x in (motion.displacement, motion.velocity))
        right = float((wave - speed / (1j * double)).abs())
        return (double * right / (2 * math.sin(k / 2) * value)) ** 2

    def stretch(value: float) -> float:
        return float(chain.elongation(path(value, torch.linspace(0, 20, 81, dtype=torch.float64)).displacement).max())

    share = 0.01
    return [
        Edge("Hertz contacts as linear", f"amplitude until the second harmonic has {share:g} of the energy",
             4 * share**0.5 / (2 * math.cos(k / 2) / math.tan(k / 2)), "second-order perturbation theory", 1.02, harmonic, share, (0.5, 2.0), None),
        Edge("Hertz contacts to second order", "amplitude until a contact opens", 1 / (2 * math.sin(k / 2)),
             "elongation 2 A sin(k / 2) = 1, of a wave that has not steepened", 1.2, stretch, 1.0, (0.3, 1.5), None),
    ]  # fmt: skip


def disorders(config: Config) -> list[tc.Disorder]:
    """Those that the theory of disorder is held against."""
    return [tc.Disorder("normal", xi) for xi in config.strengths] + [tc.Disorder("binary", xi) for xi in config.binary]


def theory_off(config: Config) -> xarray.DataArray:
    """Total variation of the theory of disorder, which needs no chains, from chains: (case, time, source)."""
    times, found = regular_times(0.0, config.stop, config.step)[1:], []
    for disorder in disorders(config):
        scene = tc.Scene(
            n_particles=config.n_particles, n_bands=config.n_bands, disorder=disorder, times=times,
            realizations=config.realizations, seed=config.seed,
        )  # fmt: skip
        chains, theory = tc.band_transfer(scene, long_time=False).mean, tc.band_transfer(scene, "theory").mean
        found.append(((theory - chains).abs().sum(-1) / 2).T)
    place = {"time": ("time", list(times), harness.TIME), "source": np.arange(1, config.n_bands + 1)}
    return xarray.DataArray(torch.stack(found).numpy(), place, ("case", "time", "source"))


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu': the edges are the methods', not the device's", repr(device))
    every = edges(config.seed)
    relative = np.geomspace(0.6, 1.7, config.points)
    curves, places, answers = [], [], []
    for edge in every:
        place = found(edge, config.halvings)
        places.append(place)
        answers.append("" if edge.public is None else answer(edge.public, beyond(edge, place)))
        inside = (edge.predicted * relative >= edge.predicted * edge.bracket[0] / 2) & (relative <= 2 * edge.bracket[1])
        curves.append(
            [
                edge.badness(x) / edge.limit if ok else np.nan
                for x, ok in zip(edge.predicted * relative, inside, strict=True)
            ]
        )
    return xarray.Dataset(
        {
            "method": ("edge", [edge.method for edge in every]),
            "quantity": ("edge", [edge.quantity for edge in every]),
            "theory": ("edge", [edge.theory for edge in every]),
            "predicted": ("edge", [edge.predicted for edge in every]),
            "found": ("edge", places),
            "factor": ("edge", [edge.factor for edge in every]),
            "answer": ("edge", answers),
            "by_design": ("edge", [edge.public is None for edge in every]),
            "badness": (("edge", "relative"), np.array(curves), {"long_name": "badness over its limit"}),
            "theory_off": theory_off(config),
        },
        {"relative": ("relative", relative, {"long_name": "value over the predicted edge"})},
    )  # fmt: skip


def kind(text: str, by_design: bool) -> str:
    """How the library meets what lies beyond an edge."""
    if by_design:
        return RIGHT
    if not text:
        return "silent"
    return "warns" if "Warning" in text.partition(":")[0] else "raises"


COLORS = {"raises": "C0", "warns": "C1", RIGHT: "0.5", "silent": "C3"}


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure = Figure(figsize=(plots.PAGE, 13), layout="constrained")
    first, second, third = figure.subplots(3, 1, height_ratios=(1.8, 1, 1))
    _edges(first, data)
    _curves(second, data)
    outline(third, data.theory_off, [f"{d.kind}, $\\xi$ = {d.strength:g}" for d in disorders(config)])
    third.set_title(f"(c) theory of disorder: energies off by {FAILS:g} or more inside the lines")
    return figure


def _edges(ax: Axes, data: xarray.Dataset) -> None:
    order = np.arange(data.sizes["edge"])[::-1]
    labels = []
    for y, i in zip(order, range(len(order)), strict=True):
        one = data.isel(edge=i)
        factor, ratio = float(one.factor), float(one.found / one.predicted)
        ax.fill_betweenx([y - 0.3, y + 0.3], 1 / factor, factor, color="0.88", linewidth=0)
        ax.plot(ratio, y, "o", color=COLORS[kind(str(one.answer.values), bool(one.by_design))])
        label = _symbols(f"{one.method.values}: {one.quantity.values}  ({float(one.predicted):.4g})")
        labels.append(textwrap.fill(label, 72, break_long_words=False))
    ax.axvline(1, color="k", linewidth=0.8)
    for name, color in COLORS.items():
        if name != "silent" or "silent" in {
            kind(str(a), bool(b)) for a, b in zip(data.answer.values, data.by_design.values, strict=True)
        }:
            ax.plot([], [], "o", color=color, label=name)
    ax.fill_between([], [], [], color="0.88", label="how sharp the prediction is")
    ax.set_yticks(order, labels, fontsize=6, linespacing=0.9)  # the predicted value in brackets
    ax.set(
        xscale="log",
        xlabel="edge found / predicted (in brackets)",
        title="(a) edges",
        xlim=(0.02, 300),
    )
    ax.xaxis.set_major_formatter("{x:g}")
    ax.legend(fontsize=8, loc="upper right", title="beyond its edge the library", title_fontsize=8)


def _symbols(words: str) -> str:
    """True symbols in place of the words of the table."""
    for word, symbol in (
        ("w_max^2", "$\\omega_{max}^2$"),
        ("w_max", "$\\omega_{max}$"),
        ("|lambda|", "$|\\lambda|$"),
        ("w step", "$\\omega$ step"),
    ):
        words = words.replace(word, symbol)
    return words


def _curves(ax: Axes, data: xarray.Dataset) -> None:
    shown = [
        ("verlet", "w_max step"), ("symplectic4", "w_max step"), ("chebyshev", "w_max^2 / bound"), ("rk4", "w_max step"),
        ("euler", "|lambda| step"), ("rk4", "|lambda| step"), ("explicit_adams", "|lambda| step"),
        ("periodic chain as infinite", "time until it differs by 0.001"), ("linear contacts", "amplitude"),
    ]  # fmt: skip
    for i, (method, quantity) in enumerate(shown):
        one = data.isel(edge=(data.method.values == method) & (data.quantity.values == quantity)).isel(edge=0)
        values = np.clip(np.nan_to_num(one.badness.values, nan=1e12, posinf=1e12), 1e-14, 1e12)
        values = np.where(np.isnan(one.badness.values) & (one.relative.values < 1), np.nan, values)
        ax.plot(
            one.relative,
            values,
            marker="os^vD<>pX"[i],
            mfc="none",
            color=(*plots.COLORS, "0.6", "0.4")[i],
            label=_symbols(f"{method}, {quantity}") if "step" in quantity else method,
        )
    ax.axhline(1, color="k", linewidth=0.8)
    ax.axvline(1, color="k", linewidth=0.8, linestyle=":")
    ax.set(yscale="log", ylim=(1e-14, 3e12), xlabel="value / predicted edge", ylabel="what goes wrong / what is allowed",
           title="(b) without guards")  # fmt: skip
    ax.legend(fontsize=8, loc="lower right")


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = []
    for i in range(data.sizes["edge"]):
        one = data.isel(edge=i)
        note = f"predicted {float(one.predicted):.5g} ({one.theory.values}); beyond: " + kind(
            str(one.answer.values), bool(one.by_design)
        )
        rows.append(Row(f"{one.method.values}: {one.quantity.values}", float(one.found), note=note))
    for disorder, off in zip(disorders(config), data.theory_off, strict=True):
        bad = off > FAILS
        note = f"{100 * float(bad.mean()):.0f} % of sources and times off by more than {FAILS:g}"
        if bool(bad.any()):
            times, bands = off.time[bad.any("source")].values, off.source[bad.any("time")].values
            note += f": bands {bands[0]} to {bands[-1]}, t = {times[0]:g} to {times[-1]:g}"
        label = f"theory of disorder, {disorder.kind} masses, xi = {disorder.strength:g}: worst source and time"
        rows.append(Row(label, float(off.max()), note=note))
    return rows


def explain(data: xarray.Dataset, config: Config) -> str:
    ratio = (data.found / data.predicted).values
    inside = (ratio <= data.factor.values) & (ratio >= 1 / data.factor.values)
    said = [f"  {m}: {a}" for m, a in zip(data.method.values, data.answer.values, strict=True) if a]
    return "\n".join(
        [
            f"measured: the edge found by {config.halvings} bisections of the method's own step, without guards.",
            f"{int(inside.sum())} of {len(inside)} edges lie where theory puts them, within its sharpness. Beyond its edge the library says:",
            *dict.fromkeys(said),
        ]
    )


SCRIPT = harness.Script("failure_map", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
