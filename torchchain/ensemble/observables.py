"""What can be measured on a trajectory: axes, unit, label and how each observable is computed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchchain.chain.chain import Chain
from torchchain.chain.excitation import Impulse
from torchchain.chain.states import Trajectory
from torchchain.energy.space import energy_center, energy_width, particle_energy, total_energy
from torchchain.energy.wavenumber import band_energy, wavenumber_energy
from torchchain.ensemble.scene import Scene

MOMENTS = frozenset({"center", "total_energy", "width"})


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


def is_fused(method: str, names: Sequence[str]) -> bool:
    """Whether the stencil's kernels measure the observables without storing states."""
    in_time = [name for name in names if name in IN_TIME]
    return method == "chebyshev" and (MOMENTS.issuperset(in_time) or in_time == ["band_energy"])
