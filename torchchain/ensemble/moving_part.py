"""The part of a chain that an impulse sets in motion by the last time; the rest stays at rest and is not computed."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain.chain.chain import Chain
from torchchain.chain.excitation import Impulse
from torchchain.chain.states import State, Trajectory
from torchchain.ensemble.observables import OBSERVABLES, chosen_observables, is_fused
from torchchain.ensemble.scene import Scene

WORTHWHILE = 0.7  # a part of the chain larger than this is not worth cutting out
WORTHWHILE_FUSED = 0.25  # nor one larger than this for kernels that skip what is at rest: the check is a run of its own
EDGE = 4  # particles beside a cut that must stay at rest
AT_REST = 1e-28  # of the energy, 1e-14 of the amplitude


class PartExceeded(Exception):
    """A wave has come to the end of the part that it was expected to stay in."""


@dataclass(frozen=True, eq=False)
class PartOfChain(Chain):
    """The part of a chain that moves, between walls where it was cut; a ring's moves as a whole as the ring does."""

    whole_rigid_mass: Tensor | None = None

    @property
    def rigid_mass(self) -> Tensor:
        return super().rigid_mass if self.whole_rigid_mass is None else self.whole_rigid_mass


@dataclass(frozen=True)
class MovingPart:
    """Particles first, ..., last - 1 of a chain of n_particles, counted from 0: all that move by the last time."""

    first: int
    last: int
    n_particles: int

    @property
    def size(self) -> int:
        return self.last - self.first

    def chain(self, chain: Chain) -> Chain:
        """The part as a chain of its own, between walls where it was cut: particles beyond stay at rest."""
        inner, contacts = slice(self.first, self.last), slice(self.first, self.last + 1)
        return PartOfChain(
            chain.masses[..., inner],
            "fixed",
            chain.contact_stiffness[..., contacts],
            chain.contact,
            chain.contact_damping[..., contacts],
            whole_rigid_mass=chain.rigid_mass,
        )

    def state(self, state: State) -> State:
        """The state of the part."""
        inner = slice(self.first, self.last)
        return State(state.displacement[..., inner], state.velocity[..., inner])

    def scene(self, scene: Scene) -> Scene:
        """The scene of a chain as long as the part, with the impulse at its place there."""
        assert isinstance(scene.excitation, Impulse)
        moved = dataclasses.replace(scene.excitation, site=scene.excitation.site - self.first)
        return dataclasses.replace(scene, n_particles=self.size, boundary="fixed", excitation=moved)

    def check(self, chain: Chain, trajectory: Trajectory) -> None:
        """An error where the part's last state moves beside a cut.

        A wave that came to a cut earlier has left motion there: behind its front a chain rings.

        Raises:
            PartExceeded: the scene needs more of the chain.
        """
        last = trajectory.final
        motion = chain.align(chain.masses, last.velocity) * last.velocity.square() + 4 * last.displacement.square()
        edge = torch.zeros_like(motion[..., 0])
        if self.first > 0:
            edge = edge + motion[..., :EDGE].sum(-1)
        if self.last < self.n_particles:
            edge = edge + motion[..., -EDGE:].sum(-1)
        if not bool((edge <= AT_REST * motion.sum(-1)).all()):
            raise PartExceeded

    def embed(self, name: str, values: Tensor) -> Tensor:
        """An observable of the part as one of the whole chain."""
        entry = OBSERVABLES[name]
        if "particle" in entry.axes:
            after = 2 * (len(entry.axes) - 1 - entry.axes.index("particle"))
            return torch.nn.functional.pad(values, (*[0] * after, self.first, self.n_particles - self.last))
        return values + self.first if entry.is_place else values


def moving_part(scene: Scene, method: str | None = None) -> MovingPart | None:
    """The part of the scene's chains that moves by the last time, or None where nothing is worth leaving out.

    On average masses a wave travels one particle per unit time; ahead of its front the motion falls like an Airy
    function of width (t / 2)^(1/3), and to 1e-16 within 15 of them. Stretches of light particles are faster, and so
    is a Hertz contact under compression. None of this is rigorous in a random chain, so :meth:`MovingPart.check` looks.

    Args:
        scene: what is wanted.
        method: that evolves the chains; None for any that stores states.
    """
    if scene.lattice is not None or not isinstance(scene.excitation, Impulse):
        return None
    if not all(o.local for o in chosen_observables(scene.observables)):
        return None
    n, site, end = scene.n_particles, scene.excitation.site - 1, float(scene.times[-1])
    distance = math.ceil(_front_speed(scene) * end + 9 * (1 + end) ** (1 / 3) + 8)
    first, last = site - distance, site + distance + 1
    if scene.boundary == "fixed":
        first, last = max(0, first), min(n, last)
    elif first < 0 or last >= n:  # a ring's contact 0 lies at its seam
        return None
    fused = method is not None and is_fused(method, scene)
    worthwhile = WORTHWHILE_FUSED if fused else WORTHWHILE
    return MovingPart(first, last, n) if last - first < worthwhile * n else None


def _front_speed(scene: Scene) -> float:
    """A speed that fronts stay below: 1 on average masses and contacts, more for disorder and for large amplitudes."""
    fastest = 1.0 if scene.mixture is None else max(1.0, scene.mixture.fastest)
    xi = scene.disorder.strength + (scene.stiffness_disorder.strength if scene.stiffness_disorder else 0.0)
    amplitude = abs(scene.excitation.velocity) if isinstance(scene.excitation, Impulse) else 0.0
    compressed = (1 + 2 * amplitude) ** 0.25 if scene.contact == "hertz" else 1.0
    return (1 + 0.3 * xi) * compressed * fastest
