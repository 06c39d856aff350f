"""Pictures of waves in two dimensions: a kick in a packing, its energy over wavenumber, a dispersion relation, an animation."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import harness
import numpy as np
import torch
import xarray
from harness import Row
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from PIL import Image

import torchchain as tc
from torchchain import network as nw
from torchchain import plots
from torchchain.chain import State

COLORS = 64  # of the animation


@dataclass(frozen=True)
class Config:
    """A packing under pressure, and lattices for the dispersion relation."""

    seed: int = 0
    """seed of the packing and of the masses"""
    n_particles: int = 900
    """disks of the packing, of two sizes"""
    fraction: float = 0.95
    """their area over that of the box"""
    times: tuple[float, ...] = (4.0, 12.0, 24.0)
    """instants of the pictures after the kick"""
    stop: float = 40.0
    """end of the animation and of the energies over wavenumber"""
    frames: int = 41
    """instants up to there"""
    largest: float = 2.0
    """longest wavevector |q| of the energies, per diameter of the small disks"""
    size: int = 72
    """of the triangular lattice"""
    strength: float = 0.2
    """disorder xi of its masses"""
    moments: int = 400
    """Chebyshev moments of S(q, w)"""


SMOKE = Config(n_particles=100, times=(2.0, 4.0), stop=4.0, frames=3, largest=0.8, size=12, moments=60)


def jammed(config: Config) -> nw.Packing:
    """Disks of radii 0.5 and 0.7 pressed into a periodic square: random places, pushed apart until all forces balance."""
    n = config.n_particles
    radii = nw.mixture(n, (0.5, 0.7), (0.5, 0.5), seed=config.seed)[0]
    side = math.sqrt(math.pi * float(radii.square().sum()) / config.fraction)
    box = torch.tensor([side, side], dtype=torch.float64)
    rng = np.random.default_rng(config.seed)
    places = torch.from_numpy(rng.random((n, 2)) * side)
    velocity, step = torch.zeros_like(places), 0.1
    positive = 0
    for _ in range(20_000):  # FIRE: Bitzek, Koskinen, Gaehler, Moseler and Gumbsch, Phys. Rev. Lett. 97, 170201, 2006
        packing = nw.packing(places, radii, torch.ones(n, dtype=torch.float64), box)
        force = packing.net(packing.bond_tension[:, None] * packing.directions)
        if float(force.abs().max()) < 1e-9:
            break
        power = float((force * velocity).sum())
        mix = 0.1 * 0.99 ** max(positive - 5, 0)
        velocity = (1 - mix) * velocity + mix * velocity.norm() * force / force.norm()
        positive = positive + 1 if power > 0 else 0
        step = min(step * 1.1, 0.5) if positive > 5 else (step * 0.5 if power < 0 else step)
        velocity = torch.zeros_like(velocity) if power < 0 else velocity
        velocity = velocity + step * force
        places = places + step * velocity
    return packing


def measure(config: Config, device: str) -> xarray.Dataset:
    packing = jammed(config)
    middle = packing.box / 2
    near = packing.nearest_image(packing.positions - middle).norm(dim=-1)
    near = torch.where(nw.rattlers(packing), math.inf, near)
    site = int(near.argmin())
    kick = torch.zeros(packing.n_particles, 2, dtype=torch.float64)
    kick[site, 0] = 1.0
    start = State(torch.zeros_like(kick), kick)
    snap = nw.particle_energy(packing, nw.evolve(packing, start, config.times, "chebyshev"))
    movie_times = torch.linspace(0, config.stop, config.frames, dtype=torch.float64)
    path = nw.evolve(packing, start, movie_times, "chebyshev")
    movie = nw.particle_energy(packing, path)
    # A wave that fits the box, half as long as the shortest counted: where its energy goes over wavenumber.
    fitting = nw.box_wavevectors(packing, config.largest)
    q = fitting[int((fitting.norm(dim=-1) - config.largest / 2).abs().argmin())]
    wave = (packing.positions @ q).cos()[:, None] * q / q.norm()
    rolling = nw.evolve(packing, State(wave, torch.zeros_like(wave)), movie_times, "chebyshev")
    waves = nw.plane_wave_energy(packing, rolling, config.largest)
    spread = nw.total_energy(packing, rolling)
    edges = torch.linspace(0, config.largest, 21, dtype=torch.float64)
    shells = nw.shell_energy(waves.lengths, waves.energy, edges)
    total = nw.total_energy(packing, path)

    ordered = nw.lattice("triangular", (config.size, config.size))
    disordered = nw.disordered(ordered, tc.Disorder(strength=config.strength), realizations=1, seed=config.seed)
    one = nw.Lattice(
        masses=disordered.masses[0],
        **{
            name: getattr(ordered, name)
            for name in ("positions", "bonds", "box", "images", "kind", "shape", "boundary", "steps")
        },
    )
    w = torch.linspace(0, 2.8, 281, dtype=torch.float64)
    # Along a bond up to the corner of the zone; beyond, the folded wavevector points elsewhere.
    turns = [(2 * m, m) for m in range(1, config.size // 3 + 1)]
    q = torch.tensor([4 * math.pi * m / config.size for _, m in turns], dtype=torch.float64)
    spectra = [
        nw.structure_factor(one, turns, w, name, config.moments).density for name in ("longitudinal", "transverse")
    ]
    return xarray.Dataset(
        {
            "positions": (("particle", "axis"), (packing.positions % packing.box).numpy()),
            "radii": ("particle", packing.radii.numpy()),
            "box": float(packing.box[0]),
            "loose": ("particle", nw.rattlers(packing).numpy()),
            "contacts": packing.n_contacts,
            "snap": (("instant", "particle"), snap.numpy()),
            "movie": (("time", "particle"), movie.numpy()),
            "shells": (("time", "shell", "polarization"), (shells / spread[:, None, None]).numpy()),
            "remainder": ("time", (waves.remainder / spread).numpy()),
            "edges": ("edge", edges.numpy()),
            "radius": ("time", nw.energy_radius(packing, movie, site + 1).numpy()),
            "energy_error": float((total / total[0] - 1).abs().max()),
            "spectrum": (("polarization", "wavevector", "frequency"), torch.stack(spectra).numpy()),
            "q": ("wavevector", q.numpy()),
            "w": ("frequency", w.numpy()),
        },
        coords={"instant": list(config.times), "time": movie_times.numpy()},
    )


def disks(axis: Any, data: xarray.Dataset, energy: np.ndarray) -> EllipseCollection:
    """The packing, each disk in the color of its energy (a power, which lets the weak be seen)."""
    width = 2 * data.radii.values
    drawn = EllipseCollection(
        width, width, 0, units="x", offsets=data.positions.values, transOffset=axis.transData, cmap="magma", lw=0
    )
    drawn.set_array(np.abs(energy) ** 0.25)
    drawn.set_clim(0, 0.6)
    axis.add_collection(drawn)
    side = float(data.box)
    axis.set(xlim=(0, side), ylim=(0, side), aspect="equal", xticks=[], yticks=[])
    return drawn


def draw(data: xarray.Dataset, config: Config) -> Figure:
    n = len(data.instant)
    figure = Figure(figsize=(plots.PAGE, 2 * plots.PAGE / max(n, 3) + 0.4), layout="constrained")
    axes = figure.subplots(2, max(n, 3), squeeze=False)
    for i, t in enumerate(data.instant.values):
        drawn = disks(axes[0, i], data, data.snap.values[i])
        axes[0, i].set_title(f"disks, t = {t:g}")
    figure.colorbar(drawn, ax=list(axes[0]), aspect=15, label="(energy / kick's unit)$^{1/4}$")
    axis = axes[1, 0]
    image = axis.pcolormesh(
        data.time, data.edges, data.shells.sum("polarization").values[:-1].T, cmap="viridis", vmax=0.2
    )
    figure.colorbar(image, ax=axis, label="share of the energy")
    axis.set(xlabel=plots.TIME_LABEL, ylabel="$|q|$", title="a plane wave: energy over |q|")
    for axis, name, p in ((axes[1, 1], "longitudinal", 0), (axes[1, 2], "transverse", 1)):
        image = axis.pcolormesh(
            data.q, data.w, np.log10(data.spectrum.values[p].T.clip(1e-3)), cmap="viridis", vmin=-1.5
        )
        q = np.linspace(0, float(data.q[-1]), 200)
        law = 3 - 2 * np.cos(q) - np.cos(q / 2) if p == 0 else 3 * (1 - np.cos(q / 2))
        axis.plot(q, np.sqrt(law), "w--", lw=1)
        axis.set(
            xlabel="$q$ along a bond",
            ylabel=r"$\omega$",
            title=rf"{name} $S(q, \omega)$, $\xi$ = {config.strength:g}" + "\n(dashed: ordered lattice)",
            xlim=(float(data.q[0]), float(data.q[-1])),
        )
        figure.colorbar(image, ax=axis, label=r"$\log_{10} S$")
    return figure


def animate(data: xarray.Dataset, file: Path) -> None:
    """The kick as a GIF of few colors, the same in all pictures."""
    figure = Figure(figsize=(4, 4), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(90)
    axis = figure.subplots()
    drawn = disks(axis, data, data.movie.values[0])
    pictures = []
    for t, energy in zip(data.time.values, data.movie.values, strict=True):
        drawn.set_array(np.abs(energy) ** 0.25)
        axis.set_title(f"t = {t:.0f}")
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]))
    sheet = Image.fromarray(np.concatenate([np.asarray(picture) for picture in pictures[:8]]))
    colors = sheet.quantize(COLORS, Image.Quantize.MAXCOVERAGE)
    pictures = [picture.quantize(palette=colors, dither=Image.Dither.NONE) for picture in pictures]
    pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=125, loop=0)


def compare(data: xarray.Dataset, config: Config) -> list[Row]:
    peaks = data.w.values[data.spectrum.values.argmax(-1)]
    q = data.q.values
    laws = np.sqrt([3 - 2 * np.cos(q) - np.cos(q / 2), 3 * (1 - np.cos(q / 2))])
    slow = q <= max(1.0, q[0])
    return [
        Row("contacts per disk that is held", 2 * float(data.contacts) / float((~data.loose).sum())),
        Row("rattlers", float(data.loose.sum())),
        Row("largest relative error of the energy", float(data.energy_error)),
        Row("R at the end over that at half of the time", float(data.radius[-1] / data.radius[len(data.time) // 2])),
        Row("share of the plane wave beyond the longest wavevector, end", float(data.remainder[-1])),
        *(
            Row(f"peaks of S(q, w) at |q| < 1, {name}: largest distance from the ordered law", float(np.abs(p - law)[slow].max()))
            for name, p, law in zip(("longitudinal", "transverse"), peaks, laws, strict=True)
        ),
    ]  # fmt: skip


def explain(data: xarray.Dataset, config: Config) -> str:
    return "With --animation FILE the kick becomes a GIF."


SCRIPT = harness.Script("network_pictures", Config(), SMOKE, measure, draw, compare, explain)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the script; ``--animation FILE`` then draws a GIF of the data saved in ``--out``."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    file = None
    if "--animation" in given[:-1]:
        at = given.index("--animation")
        file = Path(given[at + 1])
        del given[at : at + 2]
    status = harness.run(SCRIPT, given)
    if status == 0 and file is not None:
        out = Path(given[given.index("--out") + 1] if "--out" in given else "results/experiments/network_pictures")
        with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as data:
            animate(data.load(), file)
    return status


if __name__ == "__main__":
    sys.exit(main())
