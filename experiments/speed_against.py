"""Speed against another version: python experiments/speed_against.py CHECKOUT [--only WORDS].

Two processes, one with each version on its path, do the same work in turn on one thread, and what counts is the median of the ratios
of their processor times. The checkout holds the folder ``torchchain`` of the other version; kernels are compiled by calls before.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

import torchchain as tc

SLOWER = 1.1
BRIEF = 0.03
"""Seconds: shorter work is done several times over."""


@dataclass(frozen=True)
class Flags:
    """Time the same work by this version and by another, in turn."""

    checkout: tyro.conf.Positional[str]
    """folder that holds the other version's folder torchchain"""
    only: tuple[str, ...] = ()
    """cases whose names hold one of these; all where none are given"""
    repeats: int = 9
    """timings of a case by either version, after one that does not count"""
    size: int = 1
    """1: some tenths of a second a case; 0: for tests"""
    out: str = "results/speed_against"
    """folder of the report"""


Work = Callable[[], Any]


def cases(size: int) -> Iterator[tuple[str, Callable[[], Work]]]:
    """Name of each case, and what prepares it; both versions have all that is called here."""
    n, chains = (256, 12) if size else (32, 2)
    times = torch.linspace(0, 50, 51, dtype=torch.float64)
    masses = tc.Disorder(strength=0.3).masses(n, chains, 0)
    rings, walls = tc.Chain(masses), tc.Chain(masses, boundary="fixed")
    many = tc.Disorder(strength=0.3).masses(n // 8, 30, 0)

    def evolution(chain: tc.Chain, method: str, **options: Any) -> Callable[[], Work]:
        def prepare() -> Work:
            start = tc.impulse(chain, site=chain.n_particles // 2)
            return lambda: tc.evolve(chain, start, times[: 11 if "rtol" in options else 51], method, **options)

        return prepare

    yield "evolve, modes", evolution(rings, "modes")
    yield "evolve, tridiagonal", evolution(walls, "tridiagonal")
    for name, chain in (("ring", rings), ("walls", walls)):
        for method in ("chebyshev", "verlet", "symplectic4"):
            yield f"evolve, {method}, {name}", evolution(chain, method)
    yield "evolve, chebyshev, float32", evolution(tc.Chain(masses.float()), "chebyshev")
    yield "evolve, verlet, float32", evolution(tc.Chain(masses.float()), "verlet")
    hertz = tc.Chain(masses, boundary="fixed", contact="hertz")
    yield "evolve, verlet, Hertz", evolution(hertz, "verlet")
    yield "evolve, symplectic4, Hertz", evolution(hertz, "symplectic4")
    yield "evolve, verlet, damped Hertz", evolution(tc.Chain(masses, contact="hertz", damping=0.05), "verlet")
    yield "evolve, damped", evolution(tc.Chain(masses[:2, : n // 4], damping=0.05), "damped")
    for method in ("dopri5", "dopri8", "lsoda"):
        yield f"evolve, {method}", evolution(tc.Chain(many[0]), method, rtol=1e-6)
    yield "evolve, rk4", evolution(tc.Chain(many[0]), "rk4", step=0.2)
    for method in ("modes", "chebyshev"):

        def thirty(method: str = method) -> Work:
            pairs = [(chain := tc.Chain(row), tc.impulse(chain)) for row in many]
            return lambda: [tc.evolve(chain, start, times[:9], method) for chain, start in pairs]

        yield f"30 small calls, {method}", thirty

    def observed(name: str, work: Callable[[tc.Chain, tc.Trajectory], Any]) -> Iterator[tuple[str, Callable[[], Work]]]:
        for kind, chain in (("ring", rings), ("walls", walls)):

            def prepare(chain: tc.Chain = chain) -> Work:
                path = tc.evolve(chain, tc.impulse(chain, site=chain.n_particles // 2), times, "modes")
                return lambda: work(chain, path)

            yield f"{name}, {kind}", prepare

    yield from observed("particle energy by site", tc.particle_energy)
    yield from observed("particle energy by bond", lambda chain, path: tc.particle_energy(chain, path, "bond"))
    yield from observed("potential energy by site", tc.potential_energy)
    yield from observed("kinetic energy", tc.kinetic_energy)
    yield from observed("total energy", tc.total_energy)
    yield from observed("energies by wavenumber", tc.wavenumber_energy)
    yield from observed("energies in bands", lambda chain, path: tc.band_energy(chain, path, n // 8))
    yield from observed("amplitude", tc.linearity)

    def spread() -> Work:
        path = tc.evolve(rings, tc.impulse(rings, site=n // 2), times, "modes")
        energy = tc.particle_energy(rings, path, "bond")
        return lambda: (tc.energy_center(energy), tc.energy_width(energy))

    def matrices() -> Work:
        chain = tc.Chain(many)
        path = tc.evolve(chain, tc.impulse(chain), times[:9], "modes")
        return lambda: tc.wavenumber_energy_matrix(tc.energy_matrices(chain, path))

    yield "center and width", spread
    yield "energy matrices by wavenumber", matrices
    yield "moments by the stencil", lambda: lambda: tc.energy_moments(walls, tc.impulse(walls), times)
    yield "normal modes", lambda: lambda: tc.normal_modes(rings)
    yield "count of modes", lambda: lambda: tc.count_modes_below(rings, times[1:] / 25)
    yield "Lyapunov exponent", lambda: lambda: tc.lyapunov_exponent(tc.Disorder(), [0.5, 1.0], 20 * n)

    def late() -> Work:
        found = tc.normal_modes(rings)
        start = tc.standing_wave(rings, tone=n // 8)
        return lambda: tc.long_time_band_energy(rings, start, n // 8, modes=found)

    yield "long-time average", late
    yield "masses", lambda: lambda: tc.Disorder(strength=0.3).masses(n, 100, 1)
    pairs = tc.Disorder("gamma", 0.3)
    yield "masses, opposite pairs, gamma", lambda: lambda: pairs.masses(n, 100, 1, opposite_pairs=True)

    kick = tc.Impulse(site=n // 2)
    for name, method, observables in (
        ("center and width", "chebyshev", ("center", "width")),
        ("energy", "chebyshev", ("energy",)),
        ("displacement", "modes", ("displacement",)),
        ("energy of the source", "symplectic4", ("source_energy", "total_energy")),
    ):
        scene = tc.Scene(n_particles=n, boundary="fixed", excitation=kick, realizations=chains, times=times, observables=observables)  # fmt: skip
        yield f"simulate, {name}, {method}", lambda scene=scene, method=method: lambda: tc.simulate(scene, method)
    loud = tc.Scene(n_particles=n, boundary="fixed", excitation=tc.Impulse(velocity=0.3), contact="hertz", damping=0.05, realizations=chains, times=times, observables=("total_energy", "dissipated", "openings"))  # fmt: skip
    yield "simulate, damped Hertz, verlet", lambda: lambda: tc.simulate(loud, "verlet")
    small = tc.Scene(n_particles=32, n_bands=4, realizations=8, times=times)
    yield "simulate, 8 rings of 32", lambda: lambda: tc.simulate(small)
    kicked = tc.Scene(
        n_particles=32, excitation=tc.Impulse(), realizations=8, times=times, observables=("center", "width")
    )
    yield "simulate, kick, 8 rings of 32", lambda: lambda: tc.simulate(kicked)

    ours = {"starts": False} if hasattr(tc, "Network") else {}  # the other version measures bands alone

    def transfer(scene: tc.Scene, method: str, long_time: bool = True) -> Callable[[], Work]:
        return lambda: lambda: tc.band_transfer(scene, method, long_time, **ours)

    bands = tc.Scene(n_particles=n, n_bands=n // 8, realizations=chains, times=times)
    yield "transfer, chebyshev", transfer(bands, "chebyshev", False)
    yield "transfer, chebyshev, long time", transfer(bands, "chebyshev")
    yield "transfer, modes", transfer(bands, "modes")
    yield "transfer, 8 rings of 32", transfer(small, "auto")
    long = tc.Scene(n_particles=2 * n, realizations=10 if size else 2, n_bands=min(32, n // 4))
    yield "transfer, ten of the paper's rings of 512", transfer(long, "auto")
    paper = tc.Scene(n_particles=n, realizations=100 if size else 4, n_bands=min(32, n // 4))
    yield "transfer, the paper's 100 rings of 256", transfer(paper, "auto")
    yield "plan, kick", lambda: lambda: tc.plan(kicked)
    yield "plan, bands (asks the theory, too)", lambda: lambda: tc.plan(bands)

    learned: list[tc.BandTransfer] = []

    def data() -> tc.BandTransfer:
        if not learned:
            scene = tc.Scene(
                n_particles=n, n_bands=n // 8, realizations=20, times=torch.linspace(0, 50, 201, dtype=torch.float64)
            )
            learned.append(tc.band_transfer(scene, method="modes", **ours))
        return learned[0]

    def fit(model: str, method: str, **settings: Any) -> Callable[[], Work]:
        def prepare() -> Work:
            found = data()
            return lambda: tc.calibrate(found, model=model, method=method, bootstrap=0, **settings)

        return prepare

    yield "calibrate, Eq. 50", fit("paper", "analytic")
    yield "calibrate, procedure L", fit("paper", "linear")
    yield "calibrate, procedure NL", fit("paper", "nonlinear")
    for model in ("exact_psi", "basis_matrix", "swing_in"):
        yield f"calibrate, {model}, procedure L", fit(model, "linear")
    yield "calibrate, Adam", fit("paper", "adam", steps=20)
    yield "calibrate, memory of order (2, 3)", fit("memory", "projection", order=(2, 3))
    for model, method, settings in (
        ("paper", "linear", {}), ("swing_in", "linear", {}), ("memory", "projection", {"order": (2, 3)}),
    ):  # fmt: skip

        def solved(model: str = model, method: str = method, settings: dict[str, Any] = settings) -> Work:
            master = tc.calibrate(data(), model=model, method=method, bootstrap=0, **settings)
            start = torch.eye(n // 8, dtype=torch.float64)[0]
            # never the same times twice: what is kept of the last ones does not count
            counter = iter(range(10**9))
            return lambda: master.solve(start, torch.linspace(0, 45 + 1e-6 * next(counter), 501, dtype=torch.float64))

        yield f"solve, {model}", solved
    yield "solve, paper, by rk4", lambda: _by_solver(data(), n // 8)
    yield "errors drawn again, procedure L", lambda: (lambda found: lambda: tc.calibrate(found, model="paper", method="linear", bootstrap=20))(data())  # fmt: skip
    yield "Chapman-Kolmogorov", lambda: (lambda found: lambda: tc.chapman_kolmogorov(found, 5.0))(data())


def _by_solver(found: tc.BandTransfer, n_bands: int) -> Work:
    master = tc.calibrate(found, model="paper", method="linear", bootstrap=0)
    start = torch.eye(n_bands, dtype=torch.float64)[0]
    return lambda: master.solve(start, torch.linspace(0, 50, 51, dtype=torch.float64), method="rk4")


def worker(size: int) -> None:
    """Answers the name of a case on standard input by the seconds of processor time that one run takes."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    torch.zeros(2**21, dtype=torch.float64)  # once given back, malloc keeps what is smaller
    answers, sys.stdout = sys.stdout, sys.stderr
    known = dict(cases(size))
    held, times = "", 1
    work: Work = list
    for line in sys.stdin:
        name = line.rstrip("\n")
        try:
            if name != held:
                work, held, times = known[name](), name, 1
                work()
                began = time.process_time()
                work()
                times = max(1, round(BRIEF / max(time.process_time() - began, 1e-6)))
            began = time.process_time()
            for _ in range(times):
                work()
            answer = repr((time.process_time() - began) / times)
        except Exception as error:  # told to the other side
            answer = f"{type(error).__name__}: {' '.join(str(error).split())}"
        print(answer, file=answers, flush=True)


def other(folder: str, size: int) -> subprocess.Popen[str]:
    """A worker with the folder's version, kernels compiled in a place of its own."""
    environment = os.environ | {"PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
    words = [sys.executable, __file__, "--worker", str(size)]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def asked(process: subprocess.Popen[str], name: str) -> float:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(name + "\n")
    process.stdin.flush()
    answer = process.stdout.readline().strip()
    try:
        return float(answer)
    except ValueError:
        raise RuntimeError(f"{name}: {answer or 'the process ended'}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print, write; the exit status is 1 if a case is slower than in the other version by more than a tenth."""
    flags = tyro.cli(Flags, args=arguments, description=__doc__)
    names = [name for name, _ in cases(flags.size) if not flags.only or any(words in name for words in flags.only)]
    width = max(map(len, names))
    lines = [f"{'case':<{width}}  then (s)  now (s)   now / then"]
    print(lines[0])
    then, now = other(flags.checkout, flags.size), other(str(Path(tc.__file__).parents[1]), flags.size)
    slower = 0
    try:
        for name in names:
            try:
                asked(then, name), asked(now, name)
                pairs = [(asked(then, name), asked(now, name)) for _ in range(flags.repeats)]
            except RuntimeError as error:
                lines.append(f"{name:<{width}}  {error}")
                print(lines[-1], flush=True)
                continue
            ratio = statistics.median(b / a for a, b in pairs)
            seconds = [statistics.median(side) for side in zip(*pairs, strict=True)]
            slower += ratio > SLOWER
            lines.append(f"{name:<{width}}  {seconds[0]:<8.3g}  {seconds[1]:<8.3g}  {ratio:.2f}{' SLOWER' if ratio > SLOWER else ''}")  # fmt: skip
            print(lines[-1], flush=True)
    finally:
        then.terminate()
        now.terminate()
    lines.append(f"{slower} of {len(names)} cases take more than {SLOWER:g} times as long as in the other version")
    print(lines[-1])
    folder = Path(flags.out)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "report.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return int(slower > 0)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        worker(int(sys.argv[2]))
    else:
        sys.exit(main())
