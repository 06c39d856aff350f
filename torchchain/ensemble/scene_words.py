"""A scene in words: one line for titles, several for a print."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.ensemble.scene_file import plain_of

if TYPE_CHECKING:
    from torchchain.ensemble.scene import Scene


def describe(scene: Scene) -> str:
    """The scene in one line, for titles and logs."""
    wave = f"{len(scene.tones)} standing waves"
    if isinstance(scene.excitation, Impulse):
        wave = f"impulse at particle {scene.excitation.site}"
    end = np.format_float_positional(float(scene.times[-1]), trim="-")
    pairs = " in opposite pairs" if scene.sample_size == 2 else ""
    what = f"{scene.boundary} chains{pairs}, N = {scene.n_particles}"
    if scene.species:
        what += f" of {' and '.join(each.name for each in scene.species)}"
    if scene.lattice is not None:
        wave = wave.replace("standing", "plane")
        what = f"{scene.boundary} {scene.lattice} lattices{pairs}, {_shape(scene)}, {scene.motion}"
    return f"{scene.realizations} {what}, xi = {scene.disorder.strength:g}, {wave}, {len(scene.times)} times to {end}"


def rows_of(scene: Scene) -> dict[str, str]:
    """What the scene is of, line by line."""

    def words(record: Any) -> str:
        plain = {name: value for name, value in plain_of(record).items() if not isinstance(value, list)}
        return ", ".join(f"{name} {value}" for name, value in plain.items())

    wave = f"impulse: {words(scene.excitation)}"
    if isinstance(scene.excitation, StandingWave):
        wave = f"{_listed(scene.tones, 'tone', 'tones')} of a standing wave: {words(scene.excitation)}"
    contacts = f"{scene.contact}, damping {scene.largest_damping:g}"
    size = f"{scene.boundary}, of {scene.n_particles} particles"
    if scene.lattice is not None:
        wave = wave.replace("tone", "band").replace("a standing wave", "plane waves")
        contacts += f", {scene.removed_bonds:g} of the bonds removed" if scene.removed_bonds else ""
        size = f"{_shape(scene)} {scene.lattice}, motion '{scene.motion}', {scene.boundary}"
    if scene.species:
        size += f", of {', '.join(each.name for each in scene.species)} ({scene.arrangement})"
    if scene.stiffness_disorder is not None:
        contacts += f", stiffness disorder: {words(scene.stiffness_disorder)}"
    pairs = " in opposite pairs" if scene.sample_size == 2 else ""
    rows = {
        f"{scene.kind}s": f"{scene.realizations}{pairs}, {size}, seed {scene.seed}",
        "disorder": words(scene.disorder),
        "contacts": contacts,
        "excitation": wave,
        "times": _listed(scene.times.tolist(), "time", "times"),
        "observables": ", ".join(scene.observables) + (f"; {scene.n_bands} bands" if scene.needs_bands else ""),
        "energy": f"by '{scene.energy_definition}'",
        "tolerance": "the ensemble's own error" if scene.tolerance is None else f"{scene.tolerance:g}",
    }
    return rows | ({"si": words(scene.si)} if scene.si is not None else {})


def _listed(values: Sequence[float], one: str, many: str) -> str:
    """How many values, and from where to where."""
    if len(values) == 1:
        return f"{one} {values[0]:g}"
    return f"{len(values)} {many} from {values[0]:g} to {values[-1]:g}"


def _shape(scene: Scene) -> str:
    return " x ".join(map(str, scene.shape or ()))
