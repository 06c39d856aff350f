"""How the realizations of a scene are cut into groups and chunks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from torchchain.ensemble import footprint
from torchchain.ensemble.observables import IN_TIME, is_fused
from torchchain.ensemble.reach import reach
from torchchain.ensemble.scene import Scene
from torchchain.memory import memory

# Bytes of the states that go through matrix products together. On the CPU more cost more per byte: page faults.
TOGETHER = {"cpu": 2**25, "cuda": 2**30}
DECOMPOSED = {"cpu": 2**22, "cuda": 2**30}  # and of the matrices of a long-time average
GROUPS = 16  # at least so many, for the threads to share
CHUNK_WORK = 2**26  # particles times rows times times of a chunk of the stencil: about a second
BLOCKS = 20


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
    fused = device.type == "cpu" and is_fused(method, names)
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
    budget = memory(device) // 4 if memory_budget is None else memory_budget
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
