"""A few speeds of this machine, measured once and kept, for predicting the time a run takes."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import torch

from torchchain.chain import Chain
from torchchain.disorder import Disorder
from torchchain.excitation import impulse, standing_wave
from torchchain.threads import single_thread

VERSION = 2


def chebyshev_work(phase: float, accuracy: float) -> float:
    """Stencils and sums per particle from one output to the next, a highest frequency times step ``phase`` later.

    The expansion needs phase / 2 terms and some more for its accuracy; each is a stencil for displacement and for
    velocity, and is added to both.
    """
    return 6 * (phase / 2 + 4 + 0.35 * math.log10(1 / accuracy))


@dataclass(frozen=True)
class Machine:
    """Seconds per unit of counted work, on one core where a method runs one chunk a core.

    Attributes:
        version: of this record.
        cores: threads that torch uses.
        flop: of a product of matrices of 256 rows, seconds per floating-point operation.
        decomposition: dense eigen-decomposition with its check, seconds per N^3.
        tridiagonal: of a tridiagonal matrix, seconds per N^3.
        entry: of a state per particle and time in elementwise work and transforms, seconds.
        stencil: of one stencil application or sum by the compiled kernels on all cores, seconds per particle.
        update: of one step of the compiled Verlet kernel on all cores, seconds per particle.
        transform: of band energies in the compiled path on all cores, seconds per particle and time.
        compilation: seconds that the kernels take before their first use; 0 once they are compiled.
    """

    version: int = VERSION
    cores: int = 2
    flop: float = 2.0e-11
    decomposition: float = 3.5e-10
    tridiagonal: float = 6.0e-11
    entry: float = 1.6e-8
    stencil: float = 5.0e-11
    update: float = 5.0e-10
    transform: float = 6.0e-9
    compilation: float = 20.0


def this_machine(refresh: bool = False) -> Machine:
    """The speeds of this machine: from the cache, or measured in about a second and cached.

    The cache is machine.json in $TORCHCHAIN_CACHE, or in torchchain under $XDG_CACHE_HOME or ~/.cache; a folder that
    cannot be written is no error.
    """
    path = _cache_folder() / "machine.json"
    if not refresh:
        held = _read(path)
        if held is not None and held.cores == torch.get_num_threads() and (held.compilation == 0) == kernels_compiled():
            return held
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
    """Whether Numba holds the stencil's kernels in its cache, beside the source or where $NUMBA_CACHE_DIR says."""
    own = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(__file__).parent / "evolvers" / "__pycache__"
    return any(folder.glob("stencil.*.nbi")) if not own else any(Path(own).glob("**/stencil.*.nbi"))


def _seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """The shortest of some runs after a first: what the work costs where nothing else disturbs it."""
    work()
    samples = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        samples.append(time.perf_counter() - begin)
    return min(samples)


def measure() -> Machine:
    """Measure the speeds now; the compiled kernels' only if they are compiled already."""
    from torchchain.evolvers import start
    from torchchain.spectrum import normal_modes
    from torchchain.wavenumber import band_energy

    defaults = Machine()
    n = 256
    chain = Chain(Disorder().masses(n, 1, 0))
    with single_thread():
        rows = torch.ones(1024, n, dtype=torch.float64)
        square = torch.ones(n, n, dtype=torch.float64)
        flop = _seconds(lambda: rows @ square) / (2 * 1024 * n * n)
        decomposition = _seconds(lambda: normal_modes(chain)) / n**3
        state = impulse(chain)
        times = torch.arange(1.0, 257.0, dtype=torch.float64)
        modes = normal_modes(chain)

        def through_modes() -> object:
            return band_energy(chain, start(chain, state, "modes", modes=modes)(times))

        entry = max(1e-9, _seconds(through_modes) / (len(times) * n) - 4 * n * flop)
        fixed = Chain(chain.masses, "fixed")
        tridiagonal = _seconds(lambda: start(fixed, impulse(fixed), "tridiagonal")) / n**3
    stencil, update = defaults.stencil, defaults.update
    transform, compilation = defaults.transform, defaults.compilation
    if kernels_compiled():
        from torchchain.evolvers import fused

        ring = Chain(Disorder(strength=0.1).masses(1024, 8, 0))
        wave, often = standing_wave(ring, 300), torch.arange(0.0, 129.0, dtype=torch.float64)
        spent = _seconds(lambda: fused.energy_moments(ring, wave, often))
        stencil = spent / (8 * len(often) * 1024 * chebyshev_work(2.4, 1e-13))
        one = torch.tensor([200.0], dtype=torch.float64)
        update = _seconds(lambda: start(ring, wave, "verlet", step=0.1)(one)) / (8 * 1024 * 2000)
        batch = Chain(Disorder().masses(n, 8, 0))
        tones, each = standing_wave(batch, range(2, 128, 4)), torch.arange(0.0, 32.0, dtype=torch.float64)
        spent = _seconds(lambda: fused.band_energy(batch, tones, each))
        transform = max(1e-10, spent / (8 * 32 * len(each) * n) - chebyshev_work(4.5, 1e-13) * stencil)
        compilation = 0.0
    return Machine(
        VERSION,
        torch.get_num_threads(),
        flop,
        decomposition,
        tridiagonal,
        entry,
        stencil,
        update,
        transform,
        compilation,
    )
