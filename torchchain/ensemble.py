"""Stream the realizations of a scene through evolution and observables into means, error bars and long-time averages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
import xarray
from torch import Tensor
from tqdm import tqdm

from torchchain import checks, planning
from torchchain.bands import band_of
from torchchain.chain import Chain
from torchchain.energy import energy_center, energy_width, particle_energy, total_energy
from torchchain.evolvers import METHODS, Trajectory, fused, start
from torchchain.evolvers.linearity import elongation_estimate, warn_if_nonlinear
from torchchain.excitation import Impulse, StandingWave, State
from torchchain.modal_bands import modal_band_energy
from torchchain.scene import Scene
from torchchain.spectrum import NormalModes, normal_modes
from torchchain.statistics import EnsembleMoments, Moments, merged
from torchchain.threads import map_in_order, single_thread
from torchchain.wavenumber import band_energy, long_time_band_energy, wavenumber_energy

Measured = TypeVar("Measured")
MEMORY_BUDGET = 2**29
CACHE_FRIENDLY = 2**25  # states of a chunk beyond this size cost more per byte: page faults
BLOCKS = 20


@dataclass(frozen=True)
class Observable:
    """A quantity of a trajectory: the axes after realization and tone, its unit and how it is computed."""

    axes: tuple[str, ...]
    unit: str
    long_name: str
    of: Callable[[Scene, Chain, Trajectory], Tensor]


def _energy(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    return particle_energy(chain, trajectory, scene.energy_definition)


def _source_energy(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    site = scene.excitation.site if isinstance(scene.excitation, Impulse) else 1
    return _energy(scene, chain, trajectory)[..., site - 1]


ENERGY_UNIT = "contact stiffness * initial overlap^2"
IN_TIME: dict[str, Observable] = {
    "displacement": Observable(("time", "particle"), "initial overlap", "displacement", lambda s, c, t: t.displacement),
    "energy": Observable(("time", "particle"), ENERGY_UNIT, "energy per particle", _energy),
    "source_energy": Observable(("time",), ENERGY_UNIT, "energy of the source particle", _source_energy),
    "total_energy": Observable(("time",), ENERGY_UNIT, "total energy", lambda s, c, t: total_energy(c, t)),
    "center": Observable(("time",), "particle", "center of energy R", lambda s, c, t: energy_center(_energy(s, c, t))),
    "width": Observable(
        ("time",), "particle^2", "mean squared width r^2", lambda s, c, t: energy_width(_energy(s, c, t))
    ),
    "wavenumber_energy": Observable(
        ("time", "wavenumber"),
        ENERGY_UNIT,
        "energy at |k|",
        lambda s, c, t: wavenumber_energy(c, t, s.energy_definition),
    ),
    "band_energy": Observable(
        ("time", "band"),
        "1",
        "share of the energy in a band",
        lambda s, c, t: band_energy(c, t, s.n_bands, True, s.energy_definition),
    ),
}


class Stages:
    """Seconds spent in each named stage of a run; work on several threads counts its share of the time."""

    def __init__(self, share: float = 1.0) -> None:
        self.share = share
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: self.share * (time.perf_counter() - begin)})

    def add(self, seconds: dict[str, float]) -> None:
        """Take in the seconds of other stages."""
        for name, value in seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + value


@dataclass(frozen=True, eq=False)
class Chunk:
    """Realizations first, first + 1, ... of a scene, evolved together."""

    scene: Scene
    first: int
    chain: Chain
    state: State
    method: str
    options: dict[str, Any]
    times: Tensor
    window: int
    stages: Stages

    @cached_property
    def modes(self) -> NormalModes:
        """The normal modes, computed once if anything asks for them."""
        with self.stages("eigen-decomposition"):
            return normal_modes(self.chain)

    def trajectories(self) -> Iterator[Trajectory]:
        """The states at consecutive windows of the scene's times."""
        options = {"modes": self.modes, **self.options} if self.method == "modes" else self.options
        with self.stages("evolution"):
            advance = start(self.chain, self.state, self.method, **options)
        for begin in range(0, len(self.times), self.window):
            with self.stages("evolution"):
                trajectory = advance(self.times[begin : begin + self.window])
            yield trajectory

    def observe(self, names: Sequence[str]) -> dict[str, Tensor]:
        """The named observables at all times, (realization, [tone,] *axes)."""
        if not names:
            return {}
        if _is_fused(self.method, names):
            given = (self.chain, self.state, self.times)
            definition = self.scene.energy_definition
            with self.stages("evolution with observables"):
                if "band_energy" in names:
                    return {
                        "band_energy": fused.band_energy(*given, self.scene.n_bands, True, definition, **self.options)
                    }
                moments = fused.energy_moments(*given, definition, **self.options)
            every = {"total_energy": moments.total, "center": moments.center, "width": moments.width}
            return {name: every[name] for name in names}
        if self.method == "modes" and list(names) == ["band_energy"] and self.scene.energy_definition == "site":
            modes, n_bands = self.modes, self.scene.n_bands
            with self.stages("evolution with observables"):
                windows = self.times.split(self.window)
                bands = [modal_band_energy(self.chain, self.state, part, n_bands, modes=modes) for part in windows]
                return {"band_energy": torch.cat(bands, dim=-2)}
        parts: dict[str, list[Tensor]] = {name: [] for name in names}
        for trajectory in self.trajectories():
            with self.stages("observables"):
                for name in names:
                    parts[name].append(IN_TIME[name].of(self.scene, self.chain, trajectory))
        return {name: torch.cat(values, dim=-len(IN_TIME[name].axes)) for name, values in parts.items()}

    def long_time(self) -> Tensor:
        """Infinite-time average of the normalized band energies, (realization, [tone,] band)."""
        modes = self.modes
        with self.stages("long-time average"):
            return long_time_band_energy(
                self.chain, self.state, self.scene.n_bands, modes=modes, definition=self.scene.energy_definition
            )


def stream(
    scene: Scene,
    measure: Callable[[Chunk], Measured],
    method: str = "auto",
    *,
    device: str | torch.device = "cpu",
    memory_budget: int = MEMORY_BUDGET,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
) -> Iterator[tuple[int, Measured]]:
    """Measure the realizations of a scene in chunks that keep to a memory budget, in order.

    An ordered scene is one chain however many realizations it asks for, and that one is measured alone. On the CPU
    chunks run side by side, one thread each.

    Args:
        scene: what is wanted.
        measure: from a chunk to whatever is wanted of it; called on several threads.
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        device: where the chains are computed.
        memory_budget: bytes for all chunks under way; times are cut into windows where one chain exceeds it.
        progress: show a bar if the output is a terminal.
        stages: collects seconds per stage.
        options: the method's own.

    Yields:
        The first realization of the chunk, counted from 0, and what was measured.
    """
    options = dict(options or {})
    checks.choice("method", method, ("auto", *METHODS))
    device = checks.device("device", device)
    if method == "auto":
        plan = planning.plan(scene)
        method, options = plan.method, {**plan.options, **options}
    stages = stages or Stages()
    check_amplitude(scene)
    budget = checks.integer("memory_budget", memory_budget, 1)
    realizations = 1 if scene.is_ordered else scene.realizations
    workers = min(torch.get_num_threads(), realizations) if device.type == "cpu" else 1
    window, size = _chunking(scene, method, realizations, workers, budget // workers)
    times = scene.times.to(device)

    def work(numbers: range) -> tuple[range, Measured, dict[str, float]]:
        spent = Stages(1 / workers)
        with spent("masses"):
            chain = scene.chain(numbers, device)
            state = scene.state(chain)
        measured = measure(Chunk(scene, numbers[0], chain, state, method, options, times, window, spent))
        return numbers, measured, spent.seconds

    chunks = [range(first, min(first + size, realizations)) for first in range(0, realizations, size)]
    with tqdm(total=realizations, unit="chain", disable=None if progress else True, leave=False) as bar:
        for numbers, measured, seconds in map_in_order(work, chunks, workers):
            stages.add(seconds)
            yield numbers[0], measured
            bar.update(len(numbers))


def _chunking(scene: Scene, method: str, realizations: int, workers: int, budget: int) -> tuple[int, int]:
    """Times per window and realizations per chunk that keep one worker's chunk within a budget of bytes."""
    rows = max(1, len(scene.tones))
    share = -(-realizations // workers)
    if _is_fused(method, scene.observables):  # no states are stored: two chunks a worker, for the progress bar
        return len(scene.times), max(1, min(-(-share // 2), budget // (8 * rows * 12 * scene.n_particles)))
    state_bytes = 8 * rows * scene.n_particles * 10  # states, phases, transforms, products
    mode_bytes = 8 * scene.n_particles**2 * 8 if method == "modes" else 0
    window = max(1, min(len(scene.times), min(budget - mode_bytes, CACHE_FRIENDLY) // state_bytes))
    size = max(1, min(budget, mode_bytes + CACHE_FRIENDLY) // (mode_bytes + state_bytes * window))
    return window, min(size, share)


def _is_fused(method: str, names: Sequence[str]) -> bool:
    """Whether the stencil's kernels measure the observables without storing states."""
    in_time = [name for name in names if name in IN_TIME]
    return method == "chebyshev" and (planning.MOMENTS.issuperset(in_time) or in_time == ["band_energy"])


def check_amplitude(scene: Scene) -> None:
    """An error for linear contacts that the start would open, a :class:`LinearityWarning` for large amplitudes."""
    if scene.contact != "linear":
        return
    chain = scene.chain([0])
    state = scene.state(chain)
    largest = float(elongation_estimate(chain, state).max())
    if largest >= 1:
        raise checks.fail(
            "excitation",
            "stretch no linear contact beyond the initial overlap 1 (use contact 'hertz')",
            f"{largest:.3g}",
        )
    warn_if_nonlinear(chain, state, stacklevel=4)


def ensemble_moments(
    scene: Scene,
    measure: Callable[[Chunk], dict[str, Tensor]],
    method: str = "auto",
    n_blocks: int = 1,
    *,
    stages: Stages | None = None,
    **settings: Any,
) -> EnsembleMoments:
    """Moments over an ensemble of named measurements (realization, ...), and of the masses under "mass_moments".

    Args:
        scene, measure, method, stages, settings: see :func:`stream`.
        n_blocks: of consecutive realizations whose moments are kept apart.
    """
    realizations = 1 if scene.is_ordered else scene.realizations
    total = EnsembleMoments(realizations, n_blocks)
    stages = stages or Stages()

    def reduced(chunk: Chunk) -> EnsembleMoments:
        measured = {name: values.cpu() for name, values in measure(chunk).items()}
        masses = chunk.chain.masses.cpu()
        measured["mass_moments"] = torch.stack([masses.mean(-1), masses.square().mean(-1)], dim=-1)
        part = EnsembleMoments(realizations, n_blocks)
        with chunk.stages("statistics"):
            part.add(chunk.first, measured)
        return part

    for _, part in stream(scene, reduced, method, stages=stages, **settings):
        with stages("statistics"):
            total.absorb(part)
    return total


def realized_masses(moments: EnsembleMoments) -> dict[str, float]:
    """``mass_mean`` and ``mass_sd`` over all particles of all realizations."""
    mean, square = merged(moments.blocks("mass_moments")).mean.tolist()
    return {"mass_mean": mean, "mass_sd": max(0.0, square - mean**2) ** 0.5}


def simulate(
    scene: Scene,
    method: str = "auto",
    *,
    device: str | torch.device = "cpu",
    memory_budget: int = MEMORY_BUDGET,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
) -> xarray.Dataset:
    """Ensemble means of the scene's observables and their standard errors.

    Args:
        scene: what is wanted; its ``observables`` name the variables.
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        device, memory_budget, progress, stages, options: see :func:`stream`.

    Returns:
        Dataset with a variable and its ``_stderr`` for every observable, axes ([tone,] time, particle | wavenumber |
        band), coordinates counted from 1, units in the attributes; realized mass moments in the attributes.
        A single realization of a disordered chain has the standard error infinity.
    """
    stages = stages or Stages()
    in_time = [name for name in scene.observables if name in IN_TIME]

    def measure(chunk: Chunk) -> dict[str, Tensor]:
        measured = chunk.observe(in_time)
        if "long_time_band_energy" in scene.observables:
            measured["long_time_band_energy"] = chunk.long_time()
        return measured

    moments = ensemble_moments(
        scene,
        measure,
        method,
        device=device,
        memory_budget=memory_budget,
        progress=progress,
        stages=stages,
        options=options,
    )
    with single_thread():
        found = {name: merged(moments.blocks(name)) for name in scene.observables}
        return _dataset(scene, found, realized_masses(moments))


def _dataset(scene: Scene, moments: dict[str, Moments], attributes: dict[str, Any]) -> xarray.Dataset:
    leading = ("tone",) if scene.tones else ()
    variables: dict[str, Any] = {}
    used: set[str] = set()
    for name, moment in moments.items():
        entry = IN_TIME.get(name)
        axes = leading + (entry.axes if entry else ("band",))
        used.update(axes)
        notes = {
            "units": entry.unit if entry else "1",
            "long_name": entry.long_name if entry else "infinite-time average of the share of the energy in a band",
        }
        variables[name] = (axes, moment.mean.numpy(), notes)
        error = ordered_error(scene, moment)
        variables[f"{name}_stderr"] = (
            axes, error.numpy(), {**notes, "long_name": f"standard error of {notes['long_name']}"},
        )  # fmt: skip
    return xarray.Dataset(variables, coords=coordinates(scene, used), attrs=scene_attributes(scene) | attributes)


def ordered_error(scene: Scene, moment: Moments) -> Tensor:
    """Standard error of an ensemble: zero where every realization is the same chain."""
    return torch.zeros_like(moment.mean) if scene.is_ordered else moment.stderr


def coordinates(scene: Scene, axes: set[str]) -> dict[str, Any]:
    """Coordinates of the given axes, counted from 1, with units."""
    n = scene.n_particles
    k = {"units": "rad / particle distance", "long_name": "wavenumber |k|"}
    every = {
        "time": (
            "time",
            scene.times.numpy(),
            {"units": "travel time of sound over one particle", "long_name": "time t"},
        ),
        "particle": ("particle", np.arange(1, n + 1), {"long_name": "particle number p"}),
        "tone": ("tone", np.array(scene.tones, dtype=np.int64), {"long_name": "tone of the standing wave"}),
        "band": ("band", np.arange(1, scene.n_bands + 1), {"long_name": "wavenumber band r"}),
        "wavenumber": ("wavenumber", 2 * np.pi / n * np.arange(n // 2 + 1), k),
    }
    chosen = {name: every[name] for name in every if name in axes}
    if scene.si is not None and "time" in axes:
        chosen["time_si"] = ("time", scene.si.to_si("time", scene.times).numpy(), {"units": "s", "long_name": "time t"})
    if scene.si is not None and "particle" in axes:
        place = scene.si.spacing * np.arange(1, n + 1)
        chosen["place_si"] = ("particle", place, {"units": "m", "long_name": "rest position of the particle"})
    return chosen


def scene_attributes(scene: Scene) -> dict[str, Any]:
    """What every result says of its scene."""
    from torchchain import __version__

    return {
        "scene": scene.to_toml(),
        "seed": str(scene.seed),
        "realizations": scene.realizations,
        "redrawn_fraction": scene.disorder.redrawn_fraction,
        "torchchain_version": __version__,
    }


@dataclass(frozen=True, eq=False)
class BandTransfer:
    """Band energies of an ensemble in which each band in turn is the source of a unit energy.

    Attributes:
        scene: the ensemble; its tones hold one tone of every band, in order.
        times: (time,).
        mean, stderr: share of the energy, [source, time, receiver].
        long_time, long_time_stderr: infinite-time average, [source, receiver]; None if not asked for.
        block_mean: means over consecutive blocks of realizations, [block, source, time, receiver].
        block_long_time: [block, source, receiver], or None.
        block_counts: realizations in each block.
        attributes: realized mean and standard deviation of the masses, ``mass_mean`` and ``mass_sd``.
    """

    scene: Scene
    times: Tensor
    mean: Tensor
    stderr: Tensor
    long_time: Tensor | None
    long_time_stderr: Tensor | None
    block_mean: Tensor
    block_long_time: Tensor | None
    block_counts: tuple[int, ...]
    attributes: dict[str, Any] = field(default_factory=dict)

    @property
    def n_bands(self) -> int:
        return self.mean.shape[-1]

    def to_dataset(self) -> xarray.Dataset:
        """Labeled axes and units, for netCDF; :meth:`from_dataset` reads it back."""
        s, t, r, b = "source", "time", "receiver", "block"
        share = {"units": "1", "long_name": "share of the energy in the receiving band"}
        variables: dict[str, Any] = {
            "band_energy": ((s, t, r), self.mean.numpy(), share),
            "band_energy_stderr": ((s, t, r), self.stderr.numpy(), {"units": "1", "long_name": "its standard error"}),
            "block_band_energy": ((b, s, t, r), self.block_mean.numpy(), {"units": "1", "long_name": "block means"}),
            "block_count": ((b,), np.array(self.block_counts), {"units": "1", "long_name": "realizations in a block"}),
        }
        if self.long_time is not None and self.long_time_stderr is not None and self.block_long_time is not None:
            variables["long_time"] = (
                (s, r), self.long_time.numpy(), {"units": "1", "long_name": "infinite-time average of the share"},
            )  # fmt: skip
            variables["long_time_stderr"] = ((s, r), self.long_time_stderr.numpy(), {"units": "1"})
            variables["block_long_time"] = ((b, s, r), self.block_long_time.numpy(), {"units": "1"})
        bands = np.arange(1, self.n_bands + 1)
        coords = {
            **coordinates(self.scene, {"time"}),
            s: (s, bands, {"long_name": "band s of the initial standing wave"}),
            r: (r, bands, {"long_name": "receiving band r"}),
        }
        return xarray.Dataset(variables, coords=coords, attrs=scene_attributes(self.scene) | self.attributes)

    @classmethod
    def from_dataset(cls, data: xarray.Dataset) -> BandTransfer:
        """The inverse of :meth:`to_dataset`."""
        import tomllib

        scene = Scene.from_dict(tomllib.loads(data.attrs["scene"]))

        def tensor(name: str) -> Tensor:
            return torch.from_numpy(np.array(data[name].values))

        held = "long_time" in data
        return cls(
            scene,
            scene.times,
            tensor("band_energy"),
            tensor("band_energy_stderr"),
            tensor("long_time") if held else None,
            tensor("long_time_stderr") if held else None,
            tensor("block_band_energy"),
            tensor("block_long_time") if held else None,
            tuple(int(n) for n in data["block_count"].values),
            {name: float(data.attrs[name]) for name in ("mass_mean", "mass_sd")},
        )


def band_transfer(
    scene: Scene,
    method: str = "auto",
    long_time: bool = True,
    *,
    device: str | torch.device = "cpu",
    memory_budget: int = MEMORY_BUDGET,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
) -> BandTransfer:
    """The transfer of energy from every band to every band: one standing wave per band, averaged over the ensemble.

    Args:
        scene: standing waves with one tone in each of its bands, or none given (the bands' center tones).
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        long_time: also take the exact infinite-time average from the modes.
        device, memory_budget, progress, stages, options: see :func:`stream`.

    Returns:
        BandTransfer with mean and stderr [source, time, receiver].

    Raises:
        FieldError: if the excitation is no standing wave, or a band has not exactly one tone.
    """
    scene = _transfer_scene(scene)
    stages = stages or Stages()
    realizations = 1 if scene.is_ordered else scene.realizations
    n_blocks = min(BLOCKS, realizations)

    def measure(chunk: Chunk) -> dict[str, Tensor]:
        measured = chunk.observe(["band_energy"])
        return measured | ({"long_time": chunk.long_time()} if long_time else {})

    moments = ensemble_moments(
        scene,
        measure,
        method,
        n_blocks,
        device=device,
        memory_budget=memory_budget,
        progress=progress,
        stages=stages,
        options=options,
    )
    with single_thread(), stages("statistics"):
        return _transfer(scene, moments, long_time)


def _transfer(scene: Scene, moments: EnsembleMoments, long_time: bool) -> BandTransfer:
    """The BandTransfer of the blocks' moments in time and at infinite time."""
    blocks = moments.blocks("band_energy")
    total = merged(blocks)
    ends = moments.blocks("long_time") if long_time else []
    average_at_end = merged(ends) if ends else None
    return BandTransfer(
        scene,
        scene.times,
        total.mean,
        ordered_error(scene, total),
        average_at_end.mean if average_at_end else None,
        ordered_error(scene, average_at_end) if average_at_end else None,
        torch.stack([block.mean for block in blocks]),
        torch.stack([block.mean for block in ends]) if ends else None,
        tuple(block.count for block in blocks),
        realized_masses(moments),
    )


def _transfer_scene(scene: Scene) -> Scene:
    """The scene with its tones spelled out, checked for one tone in every band."""
    if not isinstance(scene.excitation, StandingWave):
        raise checks.fail("excitation", "be standing waves for a band transfer", type(scene.excitation).__name__)
    scene = replace(scene, observables=("band_energy",), excitation=replace(scene.excitation, tones=scene.tones))
    bands = [band_of(tone, scene.n_particles, scene.n_bands) for tone in scene.tones]
    if bands != list(range(1, scene.n_bands + 1)):
        raise checks.fail(
            "excitation.tones", f"lie one in each of the {scene.n_bands} bands, in order", f"bands {bands}"
        )
    return scene
