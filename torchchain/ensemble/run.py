"""Stream the realizations of a scene through evolution and observables into means, error bars and long-time averages.

Results are the same to the last bit whatever the chunks, threads and processes, and whether or not a run was killed
and went on. Matrix products round differently for another number of rows, so the realizations and times that go
through a product together are chosen from the scene alone; the stencil's kernels treat every row by itself; and the
order in which moments merge depends on realization numbers alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from torchchain import checks, progress
from torchchain.chain.amplitude import elongation_estimate, warn_if_nonlinear
from torchchain.chain.scaling import warn_of_mean
from torchchain.ensemble import plan as planning
from torchchain.ensemble.checkpoint import Checkpoint, Kept, Writer, uninterrupted
from torchchain.ensemble.chunk import Chunk
from torchchain.ensemble.layout import Layout, layout
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.statistics import EnsembleMoments, merged
from torchchain.threads import map_in_order, single_thread

Measured = TypeVar("Measured")
PRECISIONS = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True, eq=False)
class Run:
    """A scene with all that is settled before its first chain is drawn.

    Attributes:
        scene: its contact law settled.
        method, options: of the evolution, ``dtype`` among the options.
        layout: what goes through a product together, on which device.
    """

    scene: Scene
    method: str
    options: dict[str, Any]
    layout: Layout

    def chunk(self, numbers: range, stages: Stages) -> Chunk:
        """The realizations of these numbers, drawn and set in motion."""
        options = dict(self.options)
        dtype = PRECISIONS[options.pop("dtype", "float64")]
        with single_thread(), stages("masses"):
            system = self.scene.system(numbers, self.layout.device, dtype)
            state = self.scene.state(system)
        return Chunk(self.scene, numbers[0], system, state, self.method, options, self.layout, stages)


def check_settings(scene: Scene, method: str, options: Any, device: str | torch.device) -> torch.device:
    """The device; an error, before the plan draws a chain, for what no run of the scene can do."""
    checks.instance("scene", scene, Scene)
    checks.choice("method", method, ("auto", *scene.methods))
    checks.instance("options", options, dict, type(None))
    checks.choice("dtype", (options or {}).get("dtype", "float64"), PRECISIONS)
    device = checks.device("device", device)
    layout(scene, method, device)
    return device


def prepared(scene: Scene, method: str, options: dict[str, Any], device: torch.device) -> Run:
    """The run of a scene by a method."""
    check_amplitude(scene)
    return Run(scene, method, options, layout(scene, method, device))


def chosen(scene: Scene, method: str, options: dict[str, Any] | None = None) -> tuple[str, dict[str, Any]]:
    """The method and its options, the plan's where they are left to it."""
    options = dict(options or {})
    if method != "auto":
        return method, options
    plan = planning.plan(scene)
    return plan.method, {**plan.run_options, **options}


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
        numbers: realizations to measure, as ranges in order, their starts multiples of the layout's ``group``; by
            default all.

    Yields:
        The first realization of the chunk, counted from 0, and what was measured.

    Raises:
        FieldError: also if one realization at a time takes more memory than there is.
    """
    device = check_settings(scene, method, options, device)
    scene = planning.resolved(scene)
    run = prepared(scene, *chosen(scene, method, options), device)
    yield from _measured(run, measure, numbers, memory_budget, progress, stages or Stages())


def _measured(
    run: Run, measure: Callable[[Chunk], Measured], numbers: Sequence[range] | None, memory_budget: int | None,
    shown: bool, stages: Stages,
) -> Iterator[tuple[int, Measured]]:  # fmt: skip
    """:func:`stream` of a prepared run."""
    if memory_budget is not None:
        checks.integer("memory_budget", memory_budget, 1)
    every = run.scene.distinct_realizations
    numbers = [range(every)] if numbers is None else numbers
    wanted = sum(map(len, numbers))
    cut = run.layout.chunks(wanted, memory_budget)

    def work(numbers: range) -> tuple[range, Measured, dict[str, float]]:
        spent = Stages(1 / cut.workers)
        chunk = run.chunk(numbers, spent)
        with nullcontext() if run.layout.fused else single_thread():  # the kernels' bits do not depend on threads
            return numbers, measure(chunk), spent.seconds

    with progress.bar(f"{run.scene.kind}s", every, run.scene.kind, shown, every - wanted) as bar:
        for done, measured, seconds in map_in_order(work, _chunks(numbers, cut.size), cut.workers):
            stages.add(seconds)
            yield done[0], measured
            bar.update(len(done))


def _chunks(numbers: Sequence[range], size: int) -> Iterator[range]:
    """The realizations in chunks that end at multiples of a size."""
    for part in numbers:
        for first in range(part.start // size * size, part.stop, size):
            yield range(max(first, part.start), min(first + size, part.stop))


def check_amplitude(scene: Scene) -> None:
    """An error for linear contacts that the start would open, a :class:`LinearityWarning` for large amplitudes."""
    if scene.contact != "linear" or scene.lattice is not None:  # bonds of lattices never open
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
        mean, square = merged(self.moments.blocks("mass_moments")).mean.tolist()
        return {
            "mass_mean": mean,
            "mass_sd": max(0.0, square - mean**2) ** 0.5,
            "method": self.method,
            "method_options": json.dumps(self.options, default=checks.shown, sort_keys=True),
        }


def ensemble_moments(
    scene: Scene,
    method: str = "auto",
    n_blocks: int = 1,
    *,
    options: dict[str, Any] | None = None,
    device: str | torch.device = "cpu",
    memory_budget: int | None = None,
    stages: Stages | None = None,
    progress: bool = False,
    checkpoint: Checkpoint | str | Path | None = None,
    ranks: Ranks = ALONE,
) -> Ensemble:
    """Moments over an ensemble of the scene's observables, and of the masses under "mass_moments".

    Args:
        scene: what is wanted, its contact law settled.
        method, options, device, memory_budget, stages, progress: see :func:`stream`.
        n_blocks: of consecutive samples (realizations, or opposite pairs of them) whose moments are kept apart.
        checkpoint: keeps finished realizations, and those of an earlier run are not computed again.
        ranks: processes that share the realizations; each gets the result.
    """
    device, stages = check_settings(scene, method, options, device), stages or Stages()
    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    cut = scene.distinct_realizations, n_blocks, scene.sample_size
    identity = {
        "measured": list(scene.observables), "blocks": n_blocks, **scene.to_dict(),
        "method": method, "options": options or {}, "device": device.type,
    }  # fmt: skip
    with ExitStack() as held:
        # Rank 0 reads what was kept and chooses; every rank follows.
        kept = Kept(EnsembleMoments(*cut))
        begin: Any = None
        if ranks.rank == 0:
            try:
                if checkpoint is not None:
                    held.enter_context(checkpoint.lock())
                    kept = checkpoint.read(identity, *cut)
                plan = kept.plan or dict(zip(("method", "options"), chosen(scene, method), strict=True))
                begin = plan, kept.session, _missing(kept.moments.held(), scene.distinct_realizations)
            except (checks.FieldError, checks.FieldTypeError) as error:
                begin = error
        begin = ranks.agree(begin)
        if isinstance(begin, Exception):
            raise begin
        plan, session, missing = begin
        run = prepared(scene, plan["method"], {**plan["options"], **(options or {})}, device)
        writer = checkpoint.writer(session, ranks.rank, identity, plan) if checkpoint is not None else None
        own = ranks.part(missing, run.layout.group)
        parts = _measured(
            run, lambda chunk: _moments_of(chunk, cut), own, memory_budget, progress and ranks.rank == 0, stages
        )
        total = ranks.total(_collected(parts, EnsembleMoments(*cut), writer, stages, waits=ranks.size > 1))
        if ranks.rank == 0:
            total.absorb(kept.moments)
        found = Ensemble(ranks.everywhere(total), run.method, run.options)
    if ranks.rank == 0:
        warn_of_mean(found.attributes["mass_mean"], stacklevel=4)
    return found


def _moments_of(chunk: Chunk, cut: tuple[int, int, int]) -> EnsembleMoments:
    """A chunk's observables and masses, reduced."""
    measured = {name: values.cpu().double() for name, values in chunk.observe(chunk.scene.observables).items()}
    masses = chunk.system.masses.cpu().numpy()  # NumPy sums each row by itself
    measured["mass_moments"] = torch.from_numpy(np.stack([masses.mean(-1), np.square(masses).mean(-1)], axis=-1))
    part = EnsembleMoments(*cut)
    with chunk.stages("statistics"):
        part.add(chunk.first, measured)
    return part


def _collected(
    parts: Iterator[tuple[int, EnsembleMoments]], total: EnsembleMoments, writer: Writer | None, stages: Stages,
    waits: bool,
) -> EnsembleMoments:  # fmt: skip
    """The moments of all parts, saved now and then; what is finished is kept when the run is stopped or fails."""
    try:
        for _, part in parts:
            with uninterrupted():
                with stages("statistics"):
                    total.absorb(part)
                if writer is not None and writer.due:
                    with stages("checkpoint"):
                        writer.save(total)
        if writer is not None and waits:
            writer.close(total)  # the other ranks may take long
    except (KeyboardInterrupt, Exception) as error:
        if writer is None:
            raise
        if isinstance(error, KeyboardInterrupt):
            raise writer.interrupted(total) from None
        writer.close(total)
        raise
    return total


def _missing(held: Sequence[range], realizations: int) -> list[range]:
    """The realizations that are in none of the ranges, which are in order."""
    edges = [0, *(edge for part in held for edge in (part.start, part.stop)), realizations]
    return [range(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if a < b]
