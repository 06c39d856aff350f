"""What can be measured: one record an observable, one registry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.excitation import StandingWave
from torchchain.chain.states import State, Trajectory
from torchchain.energy.kicked import kicked_band_energy
from torchchain.energy.space import energy_center, energy_width
from torchchain.network import energy as spreading
from torchchain.network import systems
from torchchain.network.lattices import Lattice
from torchchain.network.trajectories import NetworkTrajectory
from torchchain.species.energy import species_band_energy, species_energy

if TYPE_CHECKING:
    from torchchain.ensemble.scene import Scene

AXES = ("time", "particle", "wavenumber", "band", "ring", "species")
CHAINS, LATTICES, MIXTURES = ("chain",), ("lattice",), ("mixture",)
BANDS, MOMENTS = {"bands", "kicked_bands"}, {"total", "center", "width"}
KERNELS = (*sorted(BANDS), *sorted(MOMENTS))


@dataclass(frozen=True)
class Observable:
    """A quantity measured on the chains of a scene.

    Attributes:
        name: in scenes, results and on the command line.
        axes: after those of realization and tone, from ``AXES``; "time" first if it is there.
        unit: in the library's units, "1" for none.
        label: a few words for axes of figures and files.
        compute: ``(scene, chain or lattice, trajectory)`` to a tensor (realization, [tone,] *axes), called with windows of times.
        average: in place of ``compute`` for what needs no times: ``(scene, chain, state, modes)`` to the same.
        local: whether particles at rest add nothing, so that they may be left out.
        is_place: whether the values count particles, from 1.
        on_a_line: whether it takes means over particle numbers: of a ring only while energy stays away from its ends.
        wavenumbers: whether it is defined in wavenumber space: linear contacts alone.
        bands: whether it needs ``n_bands``.
        damped: whether damped chains have it.
        passes: elementwise passes over a state that computing it takes, for the plan's estimate of time.
        kernel: what the stencil's kernels measure it as without storing states: "bands", of uniform rings "kicked_bands"
            with them, or "total", "center" or "width" of the energy, which come together.
        kinds: of scenes that have it: of a "chain", of a "lattice", of a "mixture" of species.

    Example:
        >>> speed = tc.Observable("speed", ("time",), "initial overlap / time", "largest speed",
        ...                       lambda scene, chain, trajectory: trajectory.velocity.abs().amax(-1), local=True)
        >>> speed.name, speed.axes
        ('speed', ('time',))
    """

    name: str
    axes: tuple[str, ...]
    unit: str
    label: str
    compute: Callable[[Scene, Any, Trajectory], Tensor] | None = None
    average: Callable[[Scene, Any, State, Any], Tensor] | None = None
    local: bool = False
    is_place: bool = False
    on_a_line: bool = False
    wavenumbers: bool = False
    bands: bool = False
    damped: bool = True
    passes: float = 20.0
    kernel: str | None = None
    kinds: tuple[str, ...] = CHAINS + LATTICES

    def __post_init__(self) -> None:
        checks.instance("observable.name", self.name, str)
        if not self.name.isidentifier() or self.name.endswith("_stderr"):
            raise checks.fail("observable.name", "be a name that does not end in _stderr", repr(self.name))
        if self.name in (*AXES, "tone", "realization"):
            raise checks.fail("observable.name", "be no axis of the results", repr(self.name))
        for field in ("unit", "label"):
            checks.instance(f"observable.{field}", getattr(self, field), str)
        for axis in self.axes:
            checks.choice("observable.axes", axis, AXES)
        if self.kernel is not None:
            checks.choice("observable.kernel", self.kernel, KERNELS)
        if (self.compute is None) == (self.average is None):
            raise checks.fail("observable", "have either compute or average", self.name)
        if not callable(self.compute or self.average):
            raise checks.FieldTypeError(f"observable must compute by a function, got {checks.shown(self.compute or self.average)}")
        if (self.compute is not None) != (self.axes[:1] == ("time",)):
            raise checks.fail("observable.axes", "start with 'time' for compute, and only then", self.axes)

    @property
    def in_time(self) -> bool:
        """Whether it is measured at the output times."""
        return self.compute is not None


System = Chain | Lattice


def _energy(scene: Scene, chain: System, trajectory: Trajectory) -> Tensor:
    return spreading.particle_energy(chain, trajectory, scene.energy_definition)


def _dissipated(scene: Scene, chain: System, trajectory: Trajectory) -> Tensor:
    if isinstance(chain, Lattice):
        return spreading.total_energy(chain, _start(scene, chain, trajectory)) - spreading.total_energy(chain, trajectory)
    return torch.zeros_like(trajectory.displacement[..., 0]) if trajectory.dissipated is None else trajectory.dissipated


def _openings(scene: Scene, chain: System, trajectory: Trajectory) -> Tensor:
    none = torch.zeros_like(trajectory.displacement[..., 0])
    return none if trajectory.openings is None else trajectory.openings.to(none)


def _band_energy(scene: Scene, chain: Any, trajectory: Trajectory) -> Tensor:
    """Share of the energy, of that at the start where damping takes some of it."""
    if scene.by_species:
        share = species_band_energy(chain, trajectory, chain.labels, len(scene.species), scene.bands_each).flatten(-2)
    else:
        share = systems.band_energy(
            chain, trajectory, scene.n_bands, scene.largest_damping == 0, _of_wavenumbers(scene)
        )
        if scene.largest_damping == 0:
            return share
    return share / spreading.total_energy(chain, _start(scene, chain, trajectory))[..., None]


def _kicked_band_energy(scene: Scene, chain: Chain, trajectory: Trajectory) -> Tensor:
    if not isinstance(scene.excitation, StandingWave):
        raise checks.fail("excitation", "be standing waves at rest for kicked_band_energy", "an impulse")
    return kicked_band_energy(chain, trajectory, scene.n_bands, definition=scene.energy_definition)


def _start(scene: Scene, chain: System, trajectory: Trajectory) -> Trajectory:
    """The start as a trajectory of one time."""
    state, axis, kind = scene.state(chain), -1, Trajectory
    if isinstance(chain, Lattice):
        axis, kind = -2, NetworkTrajectory
    fields = (x.unsqueeze(axis - 1) for x in (state.displacement, state.velocity))
    return kind(trajectory.times[:1], *fields)


def _of_wavenumbers(scene: Scene) -> str:
    """The definition of energies over wavenumbers; lattices have one."""
    return scene.energy_definition if scene.lattice is None else "site"


def _profile(scene: Scene, network: Lattice, trajectory: Trajectory) -> Tensor:
    assert scene.lattices is not None, "of lattices alone"
    edges = scene.lattices.ring_edges(scene.site)
    return spreading.radial_profile(network, _energy(scene, network, trajectory), scene.site, edges)


_JOULE = "contact stiffness * initial overlap^2"
OBSERVABLES: dict[str, Observable] = {}
"""Every observable by name; :func:`register_observable` adds to it."""


def register_observable(observable: Observable) -> Observable:
    """Make an observable of your own a name that scenes, checkpoints, files, the plan and the command line know.

    >>> import torchchain as tc
    >>> peak = tc.Observable("peak", ("time",), "initial overlap", "largest displacement",
    ...                      lambda scene, chain, trajectory: trajectory.displacement.abs().amax(-1), local=True)
    >>> _ = tc.register_observable(peak)
    >>> scene = tc.Scene(n_particles=32, realizations=2, excitation=tc.Impulse(), times=[1.0], observables=("peak",))
    >>> tc.simulate(scene)["peak"].dims
    ('time',)

    Raises:
        FieldError: for a name that is taken.
    """
    checks.instance("observable", observable, Observable)
    if observable.name in OBSERVABLES:
        raise checks.fail("observable.name", "not be taken", repr(observable.name))
    OBSERVABLES[observable.name] = observable
    return observable


for _one in (
    Observable(
        "band_energy", ("time", "band"), "1", "share of the energy in a band (of the start's energy, where damping takes some)",
        _band_energy, wavenumbers=True, bands=True, passes=30, kernel="bands",
    ),
    Observable(
        "center", ("time",), "particle", "center of energy R", lambda s, c, t: energy_center(_energy(s, c, t)),
        local=True, is_place=True, on_a_line=True, passes=18, kernel="center", kinds=CHAINS,
    ),
    Observable(
        "displacement", ("time", "particle"), "initial overlap", "displacement", lambda s, c, t: t.displacement,
        local=True, passes=2, kinds=CHAINS,
    ),
    Observable(
        "kicked_band_energy", ("time", "band"), "1", "share of the energy in a band, had the standing wave been one of velocity",
        _kicked_band_energy, wavenumbers=True, bands=True, damped=False, passes=30, kernel="kicked_bands", kinds=CHAINS,
    ),
    Observable("dissipated", ("time",), _JOULE, "energy lost to contact damping so far", _dissipated, passes=0),
    Observable("energy", ("time", "particle"), _JOULE, "energy per particle", _energy, local=True, passes=16),
    Observable(
        "long_time_band_energy", ("band",), "1", "infinite-time average of the share of the energy in a band",
        average=lambda s, c, start, modes: systems.long_time_band_energy(c, start, s.n_bands, True, modes, _of_wavenumbers(s)),
        wavenumbers=True, bands=True, damped=False,
    ),
    Observable(
        "front", ("time",), "particle distance", "radius about the source that holds 0.99 of the energy",
        lambda s, c, t: spreading.energy_front(c, _energy(s, c, t), s.site), kinds=LATTICES,
    ),
    Observable(
        "openings", ("time",), "1", "contacts that were open at any step so far", _openings, passes=0, kinds=CHAINS
    ),
    Observable(
        "radial_profile", ("time", "ring"), _JOULE, "energy in rings about the source", _profile, kinds=LATTICES
    ),
    Observable(
        "radius", ("time",), "particle distance", "mean distance R of the energy from the source",
        lambda s, c, t: spreading.energy_radius(c, _energy(s, c, t), s.site), kinds=LATTICES,
    ),
    Observable(
        "source_energy", ("time",), _JOULE, "energy of the source particle",
        lambda s, c, t: _energy(s, c, t)[..., s.site - 1], local=True, passes=14,
    ),
    Observable(
        "species_energy", ("time", "species"), _JOULE, "energy of each species",
        lambda s, c, t: species_energy(c, t, c.labels, len(s.species), s.energy_definition), passes=20, kinds=MIXTURES,
    ),
    Observable(
        "spread", ("time",), "particle distance^2", "mean squared distance r^2 of the energy from the source",
        lambda s, c, t: spreading.energy_spread(c, _energy(s, c, t), s.site), kinds=LATTICES,
    ),
    Observable(
        "total_energy", ("time",), _JOULE, "total energy", lambda s, c, t: spreading.total_energy(c, t), local=True, passes=12,
        kernel="total",
    ),
    Observable(
        "wavenumber_energy", ("time", "wavenumber"), _JOULE, "energy at |k|",
        lambda s, c, t: systems.wavenumber_energy(c, t, s.energy_definition), wavenumbers=True, passes=30, kinds=CHAINS,
    ),
    Observable(
        "width", ("time",), "particle^2", "mean squared width r^2", lambda s, c, t: energy_width(_energy(s, c, t)),
        local=True, on_a_line=True, passes=22, kernel="width", kinds=CHAINS,
    ),
):  # fmt: skip
    register_observable(_one)


def chosen_observables(names: Sequence[str]) -> list[Observable]:
    """The records of the names."""
    return [OBSERVABLES[name] for name in names]


def is_fused(method: str, scene: Scene) -> bool:
    """Whether the stencil's kernels measure all that is measured in time: the bands of all beads, or totals, centers and widths."""
    kinds = {entry.kernel for entry in chosen_observables(scene.observables) if entry.in_time}
    if method != "chebyshev" or scene.lattice is not None or scene.by_species:
        return False
    if kinds == {"bands"} or kinds <= MOMENTS:
        return True
    # Of kicks, too, where standing waves run on rings of equal contacts, whose energy is counted by sites.
    needed = {"boundary": "periodic", "stiffness_disorder": None, "species": (), "energy_definition": "site"}
    uniform = all(getattr(scene, name) == value for name, value in needed.items())
    return uniform and kinds <= BANDS and isinstance(scene.excitation, StandingWave)
