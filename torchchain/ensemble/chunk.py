"""Some realizations of a scene, evolved together and measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy.modal_bands import modal_band_energy
from torchchain.energy.wavenumber import long_time_band_energy
from torchchain.ensemble import fused
from torchchain.ensemble.observables import IN_TIME, is_fused
from torchchain.ensemble.reach import Reach, ReachExceeded
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.evolvers import start
from torchchain.modes.spectrum import NormalModes, normal_modes
from torchchain.threads import single_thread


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
        if self.reach is not None and self.reach.pays(is_fused(self.method, names)):
            with suppress(ReachExceeded):  # the whole chain, then
                return self._observe_part(self.reach, names)
        if is_fused(self.method, names):
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
