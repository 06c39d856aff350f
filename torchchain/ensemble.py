"""Stream the realizations of a scene through evolution and observables into means, error bars and long-time averages.

Results are the same to the last bit whatever the chunks, threads and processes, and whether or not a run was killed
and went on. Matrix products round differently for another number of rows, so the realizations and times that go
through a product together are chosen from the scene alone; the stencil's kernels treat every row by itself; and the
order in which moments merge depends on realization numbers alone.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
import xarray
from torch import Tensor
from tqdm import tqdm

from torchchain import checks, footprint, fused, planning
from torchchain.bands import band_of
from torchchain.chain import Chain
from torchchain.checkpoint import Checkpoint, Kept, uninterrupted
from torchchain.energy import energy_center, energy_width, particle_energy, total_energy
from torchchain.evolvers import METHODS, Trajectory, start
from torchchain.evolvers.linearity import elongation_estimate, warn_if_nonlinear
from torchchain.excitation import Impulse, StandingWave, State
from torchchain.modal_bands import modal_band_energy
from torchchain.ranks import ALONE, Ranks
from torchchain.reach import Reach, ReachExceeded, reach
from torchchain.scene import Scene
from torchchain.spectrum import NormalModes, normal_modes
from torchchain.statistics import EnsembleMoments, Moments, merged
from torchchain.threads import map_in_order, single_thread
from torchchain.wavenumber import band_energy, long_time_band_energy, wavenumber_energy

Measured = TypeVar("Measured")
# Bytes of the states that go through matrix products together. On the CPU more cost more per byte: page faults.
TOGETHER = {"cpu": 2**25, "cuda": 2**30}
DECOMPOSED = {"cpu": 2**22, "cuda": 2**30}  # and of the matrices of a long-time average
GROUPS = 16  # at least so many, for the threads to share
CHUNK_WORK = 2**26  # particles times rows times times of a chunk of the stencil: about a second
BLOCKS = 20
PRECISIONS = {"float64": torch.float64, "float32": torch.float32}


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


def _dissipated(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    return torch.zeros_like(trajectory.displacement[..., 0]) if trajectory.dissipated is None else trajectory.dissipated


def _openings(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    none = torch.zeros_like(trajectory.displacement[..., 0])
    return none if trajectory.openings is None else trajectory.openings.to(none)


def _band_energy(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    """Share of the energy, of that at the start where damping takes some of it."""
    share = band_energy(chain, trajectory, scene.n_bands, scene.damping == 0, scene.energy_definition)
    if scene.damping == 0:
        return share
    state = scene.state(chain)
    begin = Trajectory(trajectory.times[:1], state.displacement[..., None, :], state.velocity[..., None, :])
    return share / total_energy(chain, begin)[..., None]


ENERGY_UNIT = "contact stiffness * initial overlap^2"
IN_TIME: dict[str, Observable] = {
    "displacement": Observable(("time", "particle"), "initial overlap", "displacement", lambda s, c, t: t.displacement),
    "dissipated": Observable(("time",), ENERGY_UNIT, "energy lost to contact damping so far", _dissipated),
    "energy": Observable(("time", "particle"), ENERGY_UNIT, "energy per particle", _energy),
    "openings": Observable(("time",), "1", "contacts that were open at any step so far", _openings),
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
        "share of the energy in a band (of the start's energy, where damping takes some)",
        _band_energy,
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
    """Realizations first, first + 1, ... of a scene, evolved together; only the part that moves, if that is known.

    ``group`` of them, and ``window`` times, go through matrix products at once.
    """

    scene: Scene
    first: int
    chain: Chain
    state: State
    method: str
    options: dict[str, Any]
    times: Tensor
    window: int
    group: int
    stages: Stages
    reach: Reach | None = None
    watch: Callable[[Chain, Trajectory], None] | None = None

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
            if self.watch is not None:
                self.watch(self.chain, trajectory)
            yield trajectory

    def observe(self, names: Sequence[str]) -> dict[str, Tensor]:
        """The named observables at all times, (realization, [tone,] *axes)."""
        if not names:
            return {}
        if self.reach is not None and self.reach.pays(_is_fused(self.method, names)):
            with suppress(ReachExceeded):  # the whole chain, then
                return self._observe_part(self.reach, names)
        if _is_fused(self.method, names):
            given = (self.chain, self.state, self.times)
            definition = self.scene.energy_definition
            with self.stages("evolution with observables"):
                if self.watch is not None:
                    self.watch(self.chain, start(self.chain, self.state, self.method, **self.options)(self.times[-1:]))
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

    def _observe_part(self, part: Reach, names: Sequence[str]) -> dict[str, Tensor]:
        """:meth:`observe` from the part of the chains that moves."""
        inside = replace(
            self,
            scene=part.scene(self.scene),
            chain=part.chain(self.chain),
            state=part.state(self.state),
            reach=None,
            watch=part.check,
        )
        return {name: part.embed(name, values) for name, values in inside.observe(names).items()}

    def long_time(self) -> Tensor:
        """Infinite-time average of the normalized band energies, (realization, [tone,] band)."""
        if len(self.chain.masses) > self.group:
            firsts = range(0, len(self.chain.masses), self.group)
            return torch.cat([self._some(first, first + self.group).long_time() for first in firsts])
        with single_thread():
            modes = self.modes
            with self.stages("long-time average"):
                return long_time_band_energy(
                    self.chain, self.state, self.scene.n_bands, modes=modes, definition=self.scene.energy_definition
                )

    def _some(self, low: int, high: int) -> Chunk:
        """Some of the realizations."""
        chain, state, stiffness = self.chain, self.state, torch.as_tensor(self.chain.stiffness)
        return replace(
            self,
            first=self.first + low,
            chain=replace(
                chain, masses=chain.masses[low:high], stiffness=stiffness[low:high] if stiffness.ndim > 1 else stiffness
            ),
            state=State(state.displacement[low:high], state.velocity[low:high]),
        )


@dataclass(frozen=True)
class Layout:
    """How the realizations of a scene are cut.

    Attributes:
        window, group: times and realizations whose states go through matrix products together; from the scene, the
            method and the kind of device alone, as they decide how products round.
        size: realizations of a chunk, a multiple of ``group``.
        workers: chunks under way at once.
    """

    window: int
    group: int
    size: int
    workers: int


def layout(
    scene: Scene,
    method: str,
    names: Sequence[str],
    device: torch.device,
    realizations: int | None = None,
    memory_budget: int | None = None,
) -> Layout:
    """The layout of a scene's realizations, or of those of them that are still wanted.

    Raises:
        FieldError: if one realization at a time takes more memory than there is.
    """
    fused = device.type == "cpu" and _is_fused(method, names)
    axes = {name: IN_TIME[name].axes if name in IN_TIME else ("band",) for name in names}
    part = None if fused else reach(scene)
    whole, inside = (
        footprint.footprint(each, method, fused, tuple(names), axes)
        for each in (scene, part.scene(scene) if part else scene)
    )
    one = replace(inside, results=whole.results)
    every = scene.distinct_realizations
    wanted = every if realizations is None else realizations
    together, few = TOGETHER[device.type], max(1, every // GROUPS)
    window = len(scene.times) if fused else min(len(scene.times), max(1, together // one.state))
    held = one.state if fused else one.matrices + one.state * window
    footprint.check(scene, one, 1 if fused else window, BLOCKS + every.bit_length(), device)
    budget = footprint.memory(device) // 4 if memory_budget is None else memory_budget
    threads = torch.get_num_threads() if device.type == "cpu" else 1

    def whole_samples(count: int) -> int:
        return -(-count // scene.sample_size) * scene.sample_size

    if fused:
        group = whole_samples(max(1, min(few, DECOMPOSED[device.type] // (64 * scene.n_particles**2))))
        points = max(1, len(scene.tones)) * scene.n_particles * max(len(scene.times), int(scene.times[-1]))
        workers = max(1, min(threads, wanted))
        half = -(-wanted // (2 * workers))  # two chunks a worker, for the progress bar
        size = max(1, min(half, CHUNK_WORK // points, budget // workers // (held + 2 * one.results)))
        return Layout(window, group, -(-size // group) * group, workers)
    few = max(1, min(few, together // scene.n_particles))  # masses of the whole chains
    group = whole_samples(max(1, min(few, (one.matrices + together) // (held + 2 * one.results))))
    chunk = group * (held + 2 * one.results)
    return Layout(window, group, group, max(1, min(threads, -(-wanted // group), budget // chunk)))


def stream(
    scene: Scene,
    measure: Callable[[Chunk], Measured],
    method: str = "auto",
    *,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
    names: Sequence[str] | None = None,
    numbers: Sequence[range] | None = None,
) -> Iterator[tuple[int, Measured]]:
    """Measure the realizations of a scene in chunks that keep to a memory budget, in order.

    An ordered scene is one chain however many realizations it asks for, and that one is measured alone. On the CPU
    chunks run side by side, one thread each.

    Args:
        scene: what is wanted.
        measure: from a chunk to whatever is wanted of it; called on several threads.
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        device: where the chains are computed.
        memory_budget: bytes for all chunks under way, of which fewer run side by side where they exceed it, but at
            least one; by default a quarter of the memory.
        progress: show a bar if the output is a terminal.
        stages: collects seconds per stage.
        options: the method's own, and ``dtype``, "float64" or "float32".
        names: observables that ``measure`` takes; by default the scene's.
        numbers: realizations to measure, as ranges in order, their starts multiples of the layout's ``group``; by
            default all.

    Yields:
        The first realization of the chunk, counted from 0, and what was measured.

    Raises:
        FieldError: also if one realization at a time takes more memory than there is.
    """
    checks.choice("method", method, ("auto", *METHODS))
    device = checks.device("device", device)
    if memory_budget is not None:
        checks.integer("memory_budget", memory_budget, 1)
    names = scene.observables if names is None else names
    layout(scene, method, names, device)  # before the plan draws a chain
    scene = planning.resolved(scene)
    method, options = chosen(scene, method, options, names)
    dtype = PRECISIONS[checks.choice("dtype", options.pop("dtype", "float64"), PRECISIONS)]
    stages = stages or Stages()
    check_amplitude(scene)
    if numbers is None:
        numbers = [range(scene.distinct_realizations)]
    wanted = sum(map(len, numbers))
    plan = layout(scene, method, names, device, wanted, memory_budget)
    times, part = scene.times.to(device), reach(scene)

    def work(numbers: range) -> tuple[range, Measured, dict[str, float]]:
        spent = Stages(1 / plan.workers)
        with single_thread(), spent("masses"):
            chain = scene.chain(numbers, device, dtype)
            state = scene.state(chain)
        chunk = Chunk(scene, numbers[0], chain, state, method, options, times, plan.window, plan.group, spent, part)
        if device.type == "cpu" and _is_fused(method, names):  # the kernels' bits do not depend on threads
            return numbers, measure(chunk), spent.seconds
        with single_thread():
            return numbers, measure(chunk), spent.seconds

    begun = scene.distinct_realizations - wanted
    hidden = None if progress else True
    with tqdm(total=begun + wanted, initial=begun, unit="chain", disable=hidden, leave=False) as bar:
        for done, measured, seconds in map_in_order(work, _chunks(numbers, plan.size), plan.workers):
            stages.add(seconds)
            yield done[0], measured
            bar.update(len(done))


def _chunks(numbers: Sequence[range], size: int) -> Iterator[range]:
    """The realizations in chunks that end at multiples of a size."""
    for part in numbers:
        first = part.start
        while first < part.stop:
            last = min(part.stop, (first // size + 1) * size)
            yield range(first, last)
            first = last


def chosen(
    scene: Scene, method: str, options: dict[str, Any] | None = None, names: Sequence[str] | None = None
) -> tuple[str, dict[str, Any]]:
    """The method and its options, the plan's for the observables of these names where they are left to it."""
    options = dict(options or {})
    if method != "auto":
        return method, options
    plan = planning.plan(scene if names is None else replace(scene, observables=tuple(names)))
    return plan.method, {**plan.run_options, **options}


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


@dataclass(frozen=True, eq=False)
class Ensemble:
    """The moments of an ensemble, and how its chains were evolved."""

    moments: EnsembleMoments
    method: str
    options: dict[str, Any]

    @property
    def attributes(self) -> dict[str, Any]:
        """``mass_mean`` and ``mass_sd`` over all particles of all realizations, ``method`` and ``method_options``."""
        notes = {"method": self.method, "method_options": json.dumps(self.options, default=checks.shown)}
        return realized_masses(self.moments) | notes


def ensemble_moments(
    scene: Scene,
    measure: Callable[[Chunk], dict[str, Tensor]],
    method: str = "auto",
    n_blocks: int = 1,
    *,
    names: Sequence[str],
    options: dict[str, Any] | None = None,
    device: str | torch.device = "cpu",
    stages: Stages | None = None,
    progress: bool = False,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
    **settings: Any,
) -> Ensemble:
    """Moments over an ensemble of named measurements (realization, ...), and of the masses under "mass_moments".

    Args:
        scene, method, options, device, stages, progress: see :func:`stream`.
        measure: from a chunk to the measurements called ``names``.
        n_blocks: of consecutive samples (realizations, or opposite pairs of them) whose moments are kept apart.
        checkpoint: keeps finished realizations, and those of an earlier run are not computed again.
        ranks: processes that share the realizations; each gets the result.
        settings: see :func:`stream`.
    """
    realizations = scene.distinct_realizations
    cut = realizations, n_blocks, scene.sample_size
    device, stages = checks.device("device", device), stages or Stages()
    checks.instance("options", options, dict, type(None))
    checks.choice("method", method, ("auto", *METHODS))
    layout(scene, method, names, device)
    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    identity = {
        "measured": list(names), "blocks": n_blocks, **scene.to_dict(),
        "method": method, "options": options or {}, "device": device.type,
    }  # fmt: skip
    kept = Kept(EnsembleMoments(*cut))
    begin: Any = None
    if ranks.rank == 0:
        try:
            if checkpoint is not None:
                kept = checkpoint.read(identity, *cut)
            plan = kept.plan
            if plan is None:
                plan = dict(zip(("method", "options"), chosen(scene, method, names=names), strict=True))
            begin = plan, kept.session, _missing(kept.moments.held(), realizations)
        except (checks.FieldError, checks.FieldTypeError) as error:
            begin = error
    begin = ranks.agree(begin)
    if isinstance(begin, Exception):
        raise begin
    plan, session, missing = begin
    method, options = plan["method"], {**plan["options"], **(options or {})}
    total = EnsembleMoments(*cut)
    writer = checkpoint.writer(session, ranks.rank, identity, plan) if checkpoint is not None else None

    def reduced(chunk: Chunk) -> EnsembleMoments:
        measured = {name: values.cpu().double() for name, values in measure(chunk).items()}
        masses = chunk.chain.masses.cpu().numpy()  # NumPy sums each row by itself
        moments = np.stack([masses.mean(-1), np.square(masses).mean(-1)], axis=-1)
        measured["mass_moments"] = torch.from_numpy(moments)
        part = EnsembleMoments(*cut)
        with chunk.stages("statistics"):
            part.add(chunk.first, measured)
        return part

    own = ranks.share(missing, layout(scene, method, names, device).group)
    parts = stream(
        scene, reduced, method, options=options, device=device, stages=stages, names=names, numbers=own,
        progress=progress and ranks.rank == 0, **settings,
    )  # fmt: skip
    try:
        for _, part in parts:
            with uninterrupted():
                with stages("statistics"):
                    total.absorb(part)
                if writer is not None and writer.due:
                    with stages("checkpoint"):
                        writer.save(total)
        if writer is not None and ranks.size > 1:
            writer.close(total)  # the others may take long
    except KeyboardInterrupt:
        if writer is None:
            raise
        raise writer.interrupted(total, realizations) from None
    except Exception:
        if writer is not None:
            writer.close(total)
        raise
    total = ranks.total(total)
    if ranks.rank == 0:
        total.absorb(kept.moments)
    return Ensemble(ranks.everywhere(total), method, options)


def _missing(held: Sequence[range], realizations: int) -> list[range]:
    """The realizations that are in none of the ranges, which are in order."""
    edges = [0, *(edge for part in held for edge in (part.start, part.stop)), realizations]
    return [range(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b]


def realized_masses(moments: EnsembleMoments) -> dict[str, float]:
    """``mass_mean`` and ``mass_sd`` over all particles of all realizations."""
    mean, square = merged(moments.blocks("mass_moments")).mean.tolist()
    return {"mass_mean": mean, "mass_sd": max(0.0, square - mean**2) ** 0.5}


def simulate(
    scene: Scene,
    method: str = "auto",
    *,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
) -> xarray.Dataset:
    """Ensemble means of the scene's observables and their standard errors.

    Args:
        scene: what is wanted; its ``observables`` name the variables.
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        device, memory_budget, progress, stages, options: see :func:`stream`.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.
        ranks: processes that share the realizations, from :func:`torchchain.ranks.process_group`; each gets the result.

    Returns:
        Dataset with a variable and its ``_stderr`` for every observable, axes ([tone,] time, particle | wavenumber |
        band), coordinates counted from 1, units in the attributes; realized mass moments in the attributes.
        A single realization of a disordered chain has the standard error infinity.
    """
    scene, stages = planning.resolved(scene), stages or Stages()
    in_time = [name for name in scene.observables if name in IN_TIME]

    def measure(chunk: Chunk) -> dict[str, Tensor]:
        measured = chunk.observe(in_time)
        if "long_time_band_energy" in scene.observables:
            measured["long_time_band_energy"] = chunk.long_time()
        return measured

    ensemble = ensemble_moments(
        scene, measure, method, names=scene.observables, device=device, memory_budget=memory_budget, progress=progress,
        stages=stages, options=options, checkpoint=checkpoint, ranks=ranks,
    )  # fmt: skip
    with single_thread():
        found = {name: merged(ensemble.moments.blocks(name)) for name in scene.observables}
        return _dataset(scene, found, ensemble.attributes)


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
        block_counts: realizations (of opposite ones, pairs) in each block.
        attributes: realized mean and standard deviation of the masses, ``mass_mean`` and ``mass_sd``; the ``method`` that
            evolved the chains and, as JSON, its ``method_options``.
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

    def __post_init__(self) -> None:
        checks.instance("scene", self.scene, Scene)
        checks.instance("attributes", self.attributes, dict)
        object.__setattr__(self, "times", checks.times("times", self.times))
        counts, n = self.block_counts, self.scene.n_bands
        if not isinstance(counts, (list, tuple)) or not counts:
            raise checks.FieldTypeError(f"block_counts must be a list of integers, got {checks.shown(counts)}")
        object.__setattr__(self, "block_counts", tuple(checks.integer("block_counts", c, 1) for c in counts))
        whole, late, blocks = (n, len(self.times), n), (n, n), len(counts)
        shapes = {
            "mean": whole, "stderr": whole, "long_time": late, "long_time_stderr": late,
            "block_mean": (blocks, *whole), "block_long_time": (blocks, *late),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None and "long_time" in name and self.long_time is None:
                continue
            checks.instance(name, value, Tensor)
            if value.layout != torch.strided or value.is_meta or not value.is_floating_point():
                raise checks.FieldTypeError(f"{name} must be a dense floating-point tensor, got {value.dtype}")
            if tuple(value.shape) != shape:
                raise checks.fail(name, f"have shape {shape}", f"shape {tuple(value.shape)}")
            if "stderr" in name:  # infinite for one realization
                checks.first_bad(name, "not be negative", value, ~(value >= 0), "band")
            else:
                checks.real_tensor(name, value)

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
        """The inverse of :meth:`to_dataset`.

        Raises:
            FieldError, FieldTypeError: for a dataset that is not of a band transfer.
        """
        import tomllib

        checks.instance("data", data, xarray.Dataset)
        needed = ("band_energy", "band_energy_stderr", "block_band_energy", "block_count")
        late = ("long_time", "long_time_stderr", "block_long_time") if "long_time" in data else ()
        for name in (*needed, *late):
            if name not in data:
                raise checks.fail(
                    "data", f"hold the variable {name} of a band transfer", f"{', '.join(map(str, data))}"
                )
        for name in ("scene", "mass_mean", "mass_sd"):
            if name not in data.attrs:
                raise checks.fail("data", f"have the attribute {name} of a band transfer", "none")
        try:
            scene = Scene.from_dict(tomllib.loads(str(data.attrs["scene"])))
        except (ValueError, RecursionError) as error:
            raise checks.fail("data", "have the attribute scene of a band transfer", str(error)) from None
        if "time" in data.coords and not np.array_equal(data["time"].values, scene.times.numpy()):
            raise checks.fail("data", "have the times of its scene", checks.shown(data["time"].values))

        def tensor(name: str) -> Tensor:
            values = np.array(data[name].values)
            if values.dtype not in (np.float32, np.float64):
                raise checks.FieldTypeError(f"data.{name} must be of float32 or float64, got {values.dtype}")
            return torch.from_numpy(values)

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
            tuple(checks.integer("data.block_count", n, 1) for n in np.atleast_1d(data["block_count"].values)),
            {name: checks.number(f"data.{name}", data.attrs[name]) for name in ("mass_mean", "mass_sd")}
            | {name: str(data.attrs[name]) for name in ("method", "method_options") if name in data.attrs},
        )


def band_transfer(
    scene: Scene,
    method: str = "auto",
    long_time: bool = True,
    *,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    progress: bool = False,
    stages: Stages | None = None,
    options: dict[str, Any] | None = None,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
) -> BandTransfer:
    """The transfer of energy from every band to every band: one standing wave per band, averaged over the ensemble.

    Args:
        scene: standing waves with one tone in each of its bands, or none given (the bands' center tones).
        method: a name of ``evolvers.METHODS``, or "auto" for the plan's choice.
        long_time: also take the exact infinite-time average from the modes; damped chains have none.
        device, memory_budget, progress, stages, options: see :func:`stream`.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.
        ranks: processes that share the realizations, from :func:`torchchain.ranks.process_group`; each gets the result.

    Returns:
        BandTransfer with mean and stderr [source, time, receiver].

    Raises:
        FieldError: if the excitation is no standing wave, or a band has not exactly one tone.
    """
    checks.truth("long_time", long_time)
    scene, stages = _transfer_scene(planning.resolved(scene)), stages or Stages()
    long_time = long_time and scene.damping == 0
    n_blocks = min(BLOCKS, scene.distinct_realizations // scene.sample_size)

    def measure(chunk: Chunk) -> dict[str, Tensor]:
        measured = chunk.observe(["band_energy"])
        return measured | ({"long_time": chunk.long_time()} if long_time else {})

    ensemble = ensemble_moments(
        scene, measure, method, n_blocks, names=("band_energy", *["long_time_band_energy"] * long_time), device=device,
        memory_budget=memory_budget, progress=progress, stages=stages, options=options, checkpoint=checkpoint,
        ranks=ranks,
    )  # fmt: skip
    with single_thread(), stages("statistics"):
        return _transfer(scene, ensemble, long_time)


def _transfer(scene: Scene, ensemble: Ensemble, long_time: bool) -> BandTransfer:
    """The BandTransfer of the blocks' moments in time and at infinite time."""
    moments = ensemble.moments
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
        ensemble.attributes,
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
