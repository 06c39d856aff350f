"""Some realizations of a scene, evolved together and measured."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy.modal_bands import modal_band_energy
from torchchain.ensemble import fused
from torchchain.ensemble.layout import Layout
from torchchain.ensemble.moving_part import MovingPart, PartExceeded
from torchchain.ensemble.observables import MOMENTS, Observable, chosen_observables
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.stages import Stages
from torchchain.evolvers import start
from torchchain.evolvers.method import Advance
from torchchain.modes.spectrum import NormalModes
from torchchain.network.evolvers import begin
from torchchain.network.lattices import Lattice
from torchchain.network.modes import NetworkModes
from torchchain.network.systems import normal_modes
from torchchain.threads import kept_property, single_thread


@dataclass(frozen=True, eq=False)
class Chunk:
    """Realizations first, first + 1, ... of a scene, evolved together in windows of times.

    :meth:`observe` measures them the cheapest way: on the part of the chains that moves, in the stencil's kernels,
    in the basis of the modes, or from the states, as always for lattices.
    """

    scene: Scene
    first: int
    system: Chain | Lattice
    state: State
    method: str
    options: dict[str, Any]
    layout: Layout
    stages: Stages
    watch: Callable[[Chain, Trajectory], None] | None = None

    @property
    def _chain(self) -> Chain:
        assert isinstance(self.system, Chain), "of scenes of chains alone"
        return self.system

    @kept_property
    def modes(self) -> NormalModes | NetworkModes:
        """The normal modes, computed once if anything asks for them."""
        with self.stages("eigen-decomposition"):
            return normal_modes(self.system)

    @kept_property
    def times(self) -> Tensor:
        return self.scene.times.to(self.layout.device)

    def observe(self, names: Sequence[str]) -> dict[str, Tensor]:
        """The named observables, (realization, [tone,] *axes)."""
        entries = chosen_observables(names)
        found = self._in_time([entry for entry in entries if entry.in_time])
        return found | {entry.name: self._average(entry) for entry in entries if not entry.in_time}

    def _in_time(self, entries: list[Observable]) -> dict[str, Tensor]:
        if not entries:
            return {}
        if self.layout.part is not None and all(entry.local for entry in entries):
            with suppress(PartExceeded):  # the whole chain, then
                return self._of_part(self.layout.part, entries)
        kinds = {entry.kernel for entry in entries}
        if self.scene.lattice is not None or self.scene.by_species:
            return self._of_states(entries)
        if self.method == "chebyshev" and (kinds == {"bands"} or kinds <= MOMENTS):
            return self._by_kernel(entries)
        if self.layout.fused and "kicked_bands" in kinds:
            return self._by_kernel(entries)
        if self.method == "modes" and kinds == {"bands"} and self.scene.energy_definition == "site":
            bands = self._bands_by_modes()
            return {entry.name: bands for entry in entries}
        return self._of_states(entries)

    def _of_part(self, part: MovingPart, entries: list[Observable]) -> dict[str, Tensor]:
        """From the part of the chains that moves."""
        inside = replace(
            self,
            scene=part.scene(self.scene),
            system=part.chain(self._chain),
            state=part.state(self.state),
            layout=replace(self.layout, part=None),
            watch=part.check,
        )
        return {name: part.embed(name, values) for name, values in inside._in_time(entries).items()}

    def _by_kernel(self, entries: list[Observable]) -> dict[str, Tensor]:
        """From the stencil's kernels, which leave no states behind."""
        kinds, given = {entry.kernel for entry in entries}, (self._chain, self.state, self.times)
        n_bands, definition = self.scene.n_bands, self.scene.energy_definition
        with self.stages("evolution with observables"):
            if self.watch is not None:
                self.watch(self._chain, start(self._chain, self.state, self.method, **self.options)(self.times[-1:]))
            if kinds == {"bands"}:
                found = {"bands": fused.band_energy(*given, n_bands, True, definition, **self.options)}
            elif "kicked_bands" in kinds:
                both = fused.both_band_energies(*given, n_bands, **self.options)
                found = dict(zip(("bands", "kicked_bands"), both, strict=True))
            else:
                found = vars(fused.energy_moments(*given, definition, **self.options))
        return {entry.name: found[entry.kernel] for entry in entries if entry.kernel is not None}

    def _bands_by_modes(self) -> Tensor:
        modes, n_bands = self.modes, self.scene.n_bands
        assert isinstance(modes, NormalModes), "of chains"
        with self.stages("evolution with observables"):
            windows = self.times.split(self.layout.window)
            bands = [modal_band_energy(self._chain, self.state, part, n_bands, modes=modes) for part in windows]
            return torch.cat(bands, dim=-2)

    def _of_states(self, entries: list[Observable]) -> dict[str, Tensor]:
        parts: dict[str, list[Tensor]] = {entry.name: [] for entry in entries}
        for trajectory in self.trajectories():
            with self.stages("observables"):
                for entry in entries:
                    assert entry.compute is not None
                    values = entry.compute(self.scene, self.system, trajectory)
                    parts[entry.name].append(self._checked(entry, values, len(trajectory.times)))
        return {entry.name: torch.cat(parts[entry.name], dim=-len(entry.axes)) for entry in entries}

    def trajectories(self) -> Iterator[Trajectory]:
        """The states at consecutive windows of the scene's times."""
        options = {"modes": self.modes, **self.options} if self.method == "modes" else self.options
        with self.stages("evolution"):
            advance: Advance
            if isinstance(self.system, Lattice):
                advance = begin(self.system, self.state, self.method, **options)
            else:
                advance = start(self.system, self.state, self.method, **options)
        for window in self.times.split(self.layout.window):
            with self.stages("evolution"):
                trajectory = advance(window)
            if self.watch is not None:
                self.watch(self._chain, trajectory)
            yield trajectory

    def _average(self, entry: Observable) -> Tensor:
        """An observable that needs no times, a group of realizations after the other."""
        assert entry.average is not None
        group = self.layout.group
        if len(self.system.masses) > group:
            firsts = range(0, len(self.system.masses), group)
            return torch.cat([self._some(first, first + group)._average(entry) for first in firsts])
        with single_thread():
            modes = self.modes
            with self.stages("long-time average"):
                return self._checked(entry, entry.average(self.scene, self.system, self.state, modes), 0)

    def _checked(self, entry: Observable, values: Tensor, n_times: int) -> Tensor:
        """The values, if their shape is that of the observable's axes."""
        lengths = {**self.scene.lengths, "time": n_times}
        inner = 1 if isinstance(self.system, Chain) else 2  # axes of a state
        shape = (*self.state.displacement.shape[:-inner], *(lengths[axis] for axis in entry.axes))
        checks.instance(f"observable {entry.name}", values, Tensor)
        if tuple(values.shape) != shape:
            raise checks.fail(f"observable {entry.name}", f"give shape {shape}", values)
        if values.is_complex():
            raise checks.fail(f"observable {entry.name}", "give real numbers", values.dtype)
        return values

    def _some(self, low: int, high: int) -> Chunk:
        """Some of the realizations."""
        chain, state = self._chain, self.state
        each: dict[str, Any] = {
            entry.name: value[low:high]
            for entry in fields(chain)
            if entry.init and isinstance(value := getattr(chain, entry.name), Tensor) and value.ndim > 1
        }
        return replace(
            self,
            first=self.first + low,
            system=replace(chain, **each),
            state=State(state.displacement[low:high], state.velocity[low:high]),
        )
