"""The memory of a run, estimated before it is taken."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchchain import checks
from torchchain.ensemble.observables import chosen_observables
from torchchain.ensemble.scene import Scene
from torchchain.memory import gigabytes, memory

STATES = 10  # arrays of the size of the states that evolution and observables hold at once
FUSED = 12  # of the size of a state, in the stencil's kernels


@dataclass(frozen=True)
class Footprint:
    """Bytes of a run.

    Attributes:
        matrices: of a decomposition, per realization.
        state: of one output time's states, per realization.
        results: of all observables, per realization.
    """

    matrices: int
    state: int
    results: int


def footprint(scene: Scene, method: str, fused: bool) -> Footprint:
    """What one realization of a scene takes.

    Args:
        scene: what is wanted.
        method: a name of ``evolvers.METHODS``, or "auto" for what every method takes at least.
        fused: whether the stencil's kernels measure without storing states.
    """
    rows, n = max(1, len(scene.tones)), scene.n_particles * scene.n_components
    observables = chosen_observables(scene.observables)
    numbers = sum(math.prod(scene.lengths[axis] for axis in entry.axes) for entry in observables)
    averages = any(not entry.in_time for entry in observables)
    own = 0 if method == "auto" else scene.methods[method].matrices
    matrices = max(own, scene.methods["modes"].matrices * averages)
    arrays = FUSED if fused or method == "auto" else STATES
    if scene.lattices is not None:
        arrays = STATES + math.ceil(4 * scene.lattices.n_bonds / scene.n_particles)
    return Footprint(8 * matrices * n * n, 8 * rows * n * arrays, 8 * rows * numbers)


def check(scene: Scene, one: Footprint, window: int, nodes: int, device: torch.device) -> None:
    """An error, before anything is computed, where not even one realization at a time can fit.

    Args:
        scene: for the message.
        one: of one realization.
        window: times whose states are held at once.
        nodes: results that wait for others to be merged with, on the CPU.
        device: where the chains are computed.

    Raises:
        FieldError: naming the field that takes most, the rule and the estimate.
    """
    cpu = torch.device("cpu")
    for place, results in ((device, 2 * one.results), (cpu, (2 * nodes + 4) * one.results)):
        work = one.matrices + one.state * window if place == device else 0
        limit = memory(place)
        if work + results <= limit:
            continue
        words = f"at most the {gigabytes(limit)} of memory of {'this machine' if place == cpu else place}"
        if results > work:
            what = f"{', '.join(scene.observables)} at {len(scene.times)} times of {scene.n_particles} particles"
            raise checks.fail("observables", f"take {words}", f"{what}: about {gigabytes(results)}")
        raise checks.fail("n_particles", f"need {words}", f"{scene.n_particles}: about {gigabytes(work)}")
