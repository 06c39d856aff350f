"""How the realizations of a scene are cut into groups and chunks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from torchchain.ensemble import footprint
from torchchain.ensemble.moving_part import MovingPart, moving_part
from torchchain.ensemble.observables import is_fused
from torchchain.ensemble.scene import Scene
from torchchain.memory import memory

# Bytes of the states that go through matrix products together. On the CPU more cost more per byte: page faults.
TOGETHER = {"cpu": 2**25, "cuda": 2**30}
DECOMPOSED = {"cpu": 2**22, "cuda": 2**30}  # and of the matrices of a long-time average
GROUPS = 16  # at least so many, for the threads to share
CHUNK_WORK = 2**26  # particles times rows times times of a chunk of the stencil: about a second
SMALL_WORK = 2**22  # and no less than this, where there are chains enough for every worker
PARTS = 5  # chunks of a worker, for the progress bar, and that what goes on beside them may begin early
BLOCKS = 20  # independent means that statistics keep


@dataclass(frozen=True)
class Chunks:
    """Realizations of a chunk, a multiple of the layout's group, and how many chunks are under way at once."""

    size: int
    workers: int


@dataclass(frozen=True)
class Layout:
    """How a scene's realizations go through a method, from the scene, the method and the kind of device alone.

    Attributes:
        device: where the chains are computed.
        fused: whether the stencil's kernels measure without storing states.
        part: of the chains that is computed; None for all.
        window, group: times and realizations whose states go through matrix products together: they decide how
            products round.
        held: bytes of a realization under way.
        largest, least: realizations of a chunk at most, and what is not worth cutting.
    """

    device: torch.device
    fused: bool
    part: MovingPart | None
    window: int
    group: int
    held: int
    largest: int
    least: int = 1

    def chunks(self, realizations: int, memory_budget: int | None = None) -> Chunks:
        """The chunks of so many realizations that are still wanted, within bytes for all under way."""
        budget = memory(self.device) // 4 if memory_budget is None else memory_budget
        threads = torch.get_num_threads() if self.device.type == "cpu" else 1
        if self.fused:
            workers = max(1, min(threads, realizations))
            part = max(-(-realizations // (PARTS * workers)), min(self.least, -(-realizations // workers)))
            size = max(1, min(part, self.largest, budget // workers // self.held))
            return Chunks(-(-size // self.group) * self.group, workers)
        fitting = budget // (self.group * self.held)
        return Chunks(self.group, max(1, min(threads, -(-realizations // self.group), fitting)))


def layout(scene: Scene, method: str, device: torch.device) -> Layout:
    """The layout of a scene by a method, or by "auto" what every method takes at least.

    Raises:
        FieldError: if one realization at a time takes more memory than there is.
    """
    fused = device.type == "cpu" and is_fused(method, scene)
    part = moving_part(scene, method)
    cut = scene if part is None or fused else part.scene(scene)
    one = replace(footprint.footprint(cut, method, fused), results=footprint.footprint(scene, method, fused).results)
    every, n_times = scene.distinct_realizations, len(scene.times)
    least, together, few = 1, TOGETHER[device.type], max(1, every // GROUPS)
    window = n_times if fused else min(n_times, max(1, together // one.state))
    held = one.state if fused else one.matrices + one.state * window
    footprint.check(scene, one, 1 if fused else window, BLOCKS + every.bit_length(), device)
    held += 2 * one.results
    if fused:
        group = min(few, DECOMPOSED[device.type] // (64 * scene.n_particles**2))
        points = max(1, len(scene.tones)) * scene.n_particles * max(n_times, int(scene.times[-1]))
        largest, least = CHUNK_WORK // points, SMALL_WORK // points
    else:
        few = max(1, min(few, together // scene.n_particles))  # masses of the whole chains
        few = 1 if scene.position_disorder else few  # places have no axis of realizations
        group = largest = min(few, (one.matrices + together) // held)
    group = -(-max(1, group) // scene.sample_size) * scene.sample_size  # whole samples
    return Layout(device, fused, part, window, group, held, largest, least)
