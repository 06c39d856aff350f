"""A few speeds of this machine, measured once and kept, for predicting the time a run takes."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import torch

from torchchain.chain.chain import Chain
from torchchain.chain.disorder import Disorder
from torchchain.chain.excitation import impulse, standing_wave
from torchchain.ensemble import fused
from torchchain.evolvers import chebyshev, start
from torchchain.evolvers.expansion import LEAP, terms
from torchchain.modes.spectrum import normal_modes
from torchchain.threads import single_thread

VERSION = 5


@dataclass(frozen=True)
class Machine:
    """Seconds per unit of counted work on one core; the defaults are those of a 2024 server core.

    Attributes:
        version: of this record.
        cores: threads that torch uses now.
        compilation: seconds that the kernels take before their first use; 0 once they are compiled.
        loading: seconds to load the compiled kernels, once in a process.
        run: what any run takes.
        call: one operation on a small tensor.
        draw: mass of one particle.
        entry: one elementwise pass, per number.
        trig: one cosine or sine.
        flop: floating-point operation in a product of matrices.
        modes_square, modes_cube: eigen-decomposition of N particles with its check, per N^2 and per N^3.
        tridiagonal_square, tridiagonal_cube: the same by the tridiagonal solver.
        damped_square, damped_cube: the same of the damped problem.
        layout, scratch: preparing a chain and a start for the stencil kernels, per particle.
        stencil, sum, moment: the stencil, one term added to an output, the moments of an output, per particle.
        order: one Bessel function of a table of coefficients.
        transform: band energies of an output, per particle.
        pass_call: starting one loop over a chain.
        update, hertz, update_single, hertz_single: drift and kick in float64 and in float32, per particle.
        damping: contact damping over a step, per particle.
    """

    version: int = VERSION
    cores: int = 2
    compilation: float = 20.0
    loading: float = 0.5
    run: float = 2.0e-3
    call: float = 1.2e-6
    draw: float = 4.0e-8
    entry: float = 6.0e-10
    trig: float = 8.0e-9
    flop: float = 1.5e-11
    modes_square: float = 7.0e-8
    modes_cube: float = 1.6e-10
    tridiagonal_square: float = 5.0e-8
    tridiagonal_cube: float = 1.2e-10
    damped_square: float = 5.0e-7
    damped_cube: float = 2.0e-8
    layout: float = 6.0e-8
    scratch: float = 1.0e-8
    stencil: float = 3.5e-10
    sum: float = 2.0e-10
    moment: float = 8.0e-10
    order: float = 6.0e-9
    transform: float = 1.0e-8
    pass_call: float = 2.0e-8
    update: float = 6.0e-10
    hertz: float = 3.0e-9
    update_single: float = 4.0e-10
    hertz_single: float = 1.0e-9
    damping: float = 2.0e-9


def this_machine(refresh: bool = False) -> Machine:
    """The speeds of this machine: from the cache, or measured in about two seconds and cached.

    The cache is machine.json in $TORCHCHAIN_CACHE, or in torchchain under $XDG_CACHE_HOME or ~/.cache; a folder that
    cannot be written is no error.
    """
    path = _cache_folder() / "machine.json"
    if not refresh:
        held = _read(path)
        if held is not None and (held.compilation == 0) == kernels_compiled():
            return replace(held, cores=torch.get_num_threads())  # the speeds are those of one core
    machine = measure()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.part")
        part.write_text(json.dumps(asdict(machine), indent=2) + "\n")
        os.replace(part, path)
    except OSError:
        pass
    return machine


def _cache_folder() -> Path:
    own = os.environ.get("TORCHCHAIN_CACHE")
    if own:
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "torchchain"


def _read(path: Path) -> Machine | None:
    """The cached record, or None if there is none of this version with positive numbers."""
    try:
        plain = json.loads(path.read_text())
        machine = Machine(**plain)
    except (OSError, ValueError, TypeError):
        return None
    values = [getattr(machine, entry.name) for entry in fields(Machine)]
    sound = all(isinstance(v, (int, float)) and not isinstance(v, bool) and 0 <= v < 1e6 for v in values)
    return machine if sound and machine.version == VERSION else None


def kernels_compiled() -> bool:
    """Whether the stencil's kernels need no compiling."""
    return chebyshev.kernels_compiled()


def kernels_loaded() -> bool:
    """Whether this process has loaded the stencil's kernels."""
    return "torchchain.evolvers.stencil" in sys.modules


def _seconds(work: Callable[[], object], spend: float = 0.05) -> float:
    """The shortest of many short runs after a first: what the work costs where nothing else disturbs it.

    In time of this thread on its core, which leaves out what other processes take.

    Args:
        work: what to time.
        spend: seconds for all of them; at least four and at most a hundred are made.
    """
    work()
    shortest, count, spent = float("inf"), 0, 0.0
    while count < 4 or (count < 100 and spent < spend):
        begin = time.thread_time()
        work()
        taken = time.thread_time() - begin
        shortest, count, spent = min(shortest, taken), count + 1, spent + taken
    return shortest


def measure() -> Machine:
    """Measure the speeds now; the compiled kernels' only if they are compiled already."""
    cores = torch.get_num_threads()
    with single_thread():
        found = _tensors() | _decompositions()
        if kernels_compiled():
            found |= _stencils() | _steppers() | {"compilation": 0.0}
    return Machine(VERSION, cores, **found)


def _two_sizes(small: int, large: int, seconds: Callable[[int], float]) -> tuple[float, float]:
    """Factors of N^2 and N^3, neither negative, from the times at two sizes beyond those of a tiny one."""
    least = seconds(4)
    low, high = (max(0.0, seconds(n) - least) / n**2 for n in (small, large))
    cube = max(0.0, (high - low) / (large - small))
    return max(0.0, low - cube * small), cube


def _tensors() -> dict[str, float]:
    """Speeds of torch's own operations."""
    few, many = torch.ones(8, dtype=torch.float64), torch.linspace(0, 50, 2**14, dtype=torch.float64)
    square, rows = torch.ones(256, 256, dtype=torch.float64), torch.ones(512, 256, dtype=torch.float64)

    def calls() -> None:
        for _ in range(50):
            few + few

    def passes() -> None:
        for _ in range(4):
            many * many + many

    return {
        "call": _seconds(calls) / 50,
        "entry": _seconds(passes) / 8 / len(many),
        "trig": _seconds(many.cos) / len(many),
        "flop": _seconds(lambda: rows @ square) / (2 * 512 * 256 * 256),
        "draw": _seconds(lambda: Disorder().masses(2**14, 1, 0)) / 2**14,
    }


def _decompositions() -> dict[str, float]:
    """Eigen-decompositions, whose time lies between N^2 and N^3."""

    def chain(n: int, damping: float = 0.0) -> Chain:
        return Chain(Disorder().masses(n, 1, 0), "fixed", damping=damping)

    def by(method: str, damping: float = 0.0) -> Callable[[int], float]:
        def seconds(n: int) -> float:
            given = chain(n, damping)
            state = impulse(given)
            return _seconds(lambda: start(given, state, method))

        return seconds

    modes = _two_sizes(64, 320, lambda n: _seconds(lambda: normal_modes(chain(n))))
    tridiagonal = _two_sizes(64, 320, by("tridiagonal"))
    damped = _two_sizes(24, 96, by("damped", 0.05))
    return {
        "modes_square": modes[0], "modes_cube": modes[1], "tridiagonal_square": tridiagonal[0],
        "tridiagonal_cube": tridiagonal[1], "damped_square": damped[0], "damped_cube": damped[1],
    }  # fmt: skip


def _stencils() -> dict[str, float]:
    """The kernels of the Chebyshev expansion, from runs that differ in what they do most of."""
    n = 1024
    ring = Chain(Disorder(strength=0.1).masses(n, 1, 0))
    wave = standing_wave(ring, 300)
    top = float(ring.squared_frequency_bound(8).max().sqrt())

    def run(times: torch.Tensor) -> float:
        return _seconds(lambda: fused.energy_moments(ring, wave, times, accuracy=1e-12))

    idle = run(torch.zeros(1, dtype=torch.float64))
    far = (run(torch.tensor([4 * LEAP / top], dtype=torch.float64)) - idle) / n
    dense = (run(torch.arange(0, 257, dtype=torch.float64) * 2 / top) - idle) / n
    # far: 4 leaps of two expansions; dense: 32 segments of 8 outputs by one expansion each.
    degree, reach, mean = terms(LEAP, 1e-12), terms(16, 1e-12), terms(9, 1e-12)
    # Moments take about as long as four sums of a term.
    stencil_and_sum = far / (8 * degree)
    add = max(0.1 * stencil_and_sum, (dense - 32 * reach * stencil_and_sum) / (256 * (mean + 4) - 32 * reach))
    stencil = max(0.1 * stencil_and_sum, stencil_and_sum - add)
    batch, tones = Chain(Disorder().masses(256, 1, 0)), range(2, 128, 8)
    waves, often = standing_wave(batch, tones), torch.arange(0.0, 32.0, dtype=torch.float64)
    bands = _seconds(lambda: fused.band_energy(batch, waves, often, accuracy=1e-12))
    moments = _seconds(lambda: fused.energy_moments(batch, waves, often, accuracy=1e-12))
    transform = (bands - moments) / (len(tones) * len(often) * 256) + 4 * add
    short = Chain(Disorder().masses(8, 1, 0), "fixed")
    uneven = torch.arange(1, 65, dtype=torch.float64).sqrt()
    kick = impulse(short)
    begin = _seconds(lambda: fused.energy_moments(short, kick, uneven[:1], accuracy=1e-12))
    tables = _seconds(lambda: fused.energy_moments(short, kick, uneven, accuracy=1e-12)) - begin
    return {
        "layout": max(1e-9, idle / n * 0.6), "scratch": max(1e-10, idle / n * 0.2), "stencil": stencil, "sum": add,
        "moment": 4 * add, "transform": max(1e-10, transform), "order": max(1e-10, tables / (64 * 70)),
    }  # fmt: skip


def _steppers() -> dict[str, float]:
    """The symplectic kernels: both laws, both precisions, damping, and what a loop takes by itself."""
    few, many, n = 200, 2200, 512

    def step(n: int, contact: str = "linear", dtype: torch.dtype = torch.float64, damping: float = 0.0) -> float:
        chain = Chain(Disorder(strength=0.1).masses(n, 1, 0).to(dtype), "fixed", contact=contact, damping=damping)
        state = standing_wave(chain, 1)

        def run(steps: int) -> float:
            end = torch.tensor([0.1 * steps], dtype=torch.float64)
            return _seconds(lambda: start(chain, state, "verlet", step=0.1001)(end))

        return max(1e-11 * n, (run(many) - run(few)) / (many - few))

    small, large = step(8), step(n)
    update = max(1e-11, (large - small) / (n - 8))
    return {
        "update": update,
        "pass_call": max(1e-9, small - 8 * update),
        "hertz": step(n, "hertz") / n,
        "update_single": step(n, dtype=torch.float32) / n,
        "hertz_single": step(n, "hertz", torch.float32) / n,
        "damping": max(1e-10, (step(n, damping=0.05) - large) / n),
    }
