"""Stream the realizations of a scene through evolution and observables into means, error bars and long-time averages.

Results are the same to the last bit whatever the chunks, threads and processes, and whether or not a run was killed
and went on. Matrix products round differently for another number of rows, so the realizations and times that go
through a product together are chosen from the scene alone; the stencil's kernels treat every row by itself; and the
order in which moments merge depends on realization numbers alone.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from torchchain import checks
from torchchain.chain.amplitude import elongation_estimate, warn_if_nonlinear
from torchchain.ensemble import plan as planning
from torchchain.ensemble.checkpoint import Checkpoint, Kept, uninterrupted
from torchchain.ensemble.chunk import Chunk
from torchchain.ensemble.layout import layout
from torchchain.ensemble.observables import is_fused
from torchchain.ensemble.ranks import ALONE, Ranks
from torchchain.ensemble.reach import reach
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.statistics import EnsembleMoments, merged
from torchchain.evolvers import METHODS
from torchchain.threads import map_in_order, single_thread

Measured = TypeVar("Measured")
PRECISIONS = {"float64": torch.float64, "float32": torch.float32}


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
        if device.type == "cpu" and is_fused(method, names):  # the kernels' bits do not depend on threads
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
