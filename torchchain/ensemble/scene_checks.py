"""The rules of a scene that concern several of its fields."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from torchchain import checks
from torchchain.chain.disorder import Disorder
from torchchain.chain.excitation import Impulse, StandingWave
from torchchain.chain.scaling import Scaling
from torchchain.ensemble.observables import OBSERVABLES, chosen_observables
from torchchain.network.lattices import BOUNDARIES as LATTICE_BOUNDARIES

if TYPE_CHECKING:
    from torchchain.ensemble.scene import Scene

_RECORDS: tuple[tuple[str, tuple[type, ...], str], ...] = (
    ("disorder", (Disorder,), "tc.Disorder(strength=0.3)"),
    ("excitation", (Impulse, StandingWave), "tc.Impulse(site=1)"),
    ("stiffness_disorder", (Disorder,), "tc.Disorder(strength=0.3)"),
    ("si", (Scaling,), "tc.Scaling(...)"),
)


def check_lattice(scene: Scene, put: Callable[[str, Any], None]) -> None:
    """Checks what lattices have of their own, and fills in what follows from it."""
    if isinstance(scene.shape, list):
        put("shape", tuple(scene.shape))
    if scene.shape is None:
        raise checks.fail("shape", "be given for a lattice", None)
    checks.choice("boundary", scene.boundary, LATTICE_BOUNDARIES)
    checks.number("damping", scene.damping, at_least=0)
    if scene.contact == "auto":
        put("contact", "linear")
    if scene.contact != "linear":
        raise checks.fail("contact", "be 'linear' for a lattice", repr(scene.contact))
    if scene.si is not None:
        raise checks.fail("si", "be left out for a lattice", "beads")
    if scene.position_disorder and scene.opposite_pairs:
        raise checks.fail("opposite_pairs", "be False with position_disorder", scene.opposite_pairs)
    checks.instance("disorder", scene.disorder, Disorder)
    checks.instance("stiffness_disorder", scene.stiffness_disorder, Disorder, type(None))
    lattices = scene.lattices
    assert lattices is not None
    n = lattices.n_particles
    if scene.n_particles not in (None, n):
        raise checks.fail(
            "n_particles", f"be left out for a lattice of shape {scene.shape}, which has {n}", scene.n_particles
        )
    put("n_particles", n)
    for name in ("shape", "removed_bonds", "position_disorder"):
        put(name, getattr(lattices, {"position_disorder": "moved"}.get(name, name)))
    if scene.n_bands is None:
        put("n_bands", lattices.default_bands)


def left_out(scene: Scene, defaults: dict[str, Any], of: str) -> None:
    """An error for fields of what the scene is not of."""
    for name, default in defaults.items():
        value = getattr(scene, name)
        if not (value is default or (isinstance(value, (str, int, float)) and value == default)):
            raise checks.fail(name, f"be left out without {of}", checks.shown(value))


def check_mixture(scene: Scene, put: Callable[[str, Any], None]) -> None:
    """Checks what mixtures have of their own."""
    if isinstance(scene.unlike, list):
        put("unlike", tuple(scene.unlike))
    mixture = scene.mixture
    assert mixture is not None, "of species"
    put("unlike", mixture.unlike)
    if scene.lattice is not None:
        raise checks.fail("species", "be left out for a lattice", [each.name for each in scene.species])
    for name, wanted in (("damping", 0.0), ("si", None), ("opposite_pairs", False)):
        value = getattr(scene, name)
        if value is not wanted and value != wanted:
            rule = "be that of the species" if name == "damping" else "be left out for a mixture"
            raise checks.fail(name, rule, checks.shown(value))
    checks.truth("by_species", scene.by_species)
    if not scene.by_species:
        return
    if checks.integer("n_bands", scene.n_bands, 1) % len(scene.species):
        raise checks.fail("n_bands", f"be a multiple of the {len(scene.species)} species", scene.n_bands)
    for name, needed in (("boundary", "periodic"), ("contact", "linear")):
        if getattr(scene, name) != needed:
            raise checks.fail(name, f"be {needed!r} for by_species", repr(getattr(scene, name)))


def check_excitation(scene: Scene) -> None:
    """Checks site or tones against particles and bands."""
    if (scene.lattice is None and not scene.by_species) or isinstance(scene.excitation, Impulse):
        scene.excitation.check(scene.n_particles)
        return
    for tone in scene.excitation.tones or ():
        checks.integer("excitation.tones", tone, 1, scene.n_bands)


def check_records(scene: Scene) -> None:
    """Checks that disorder, excitation and the like are what they must be."""
    for name, kinds, example in _RECORDS:
        value = getattr(scene, name)
        if not isinstance(value, kinds) and not (value is None and name in ("stiffness_disorder", "si")):
            words = " or ".join(checks.with_article(kind.__name__) for kind in kinds)
            raise checks.FieldTypeError(f"{name} must be {words}, e.g. {example}, got {checks.shown(value)}")


def check_observables(scene: Scene) -> None:
    """Checks that every observable is one of this scene's systems."""
    for entry in chosen_observables(scene.observables):
        of = f"for the observable {entry.name}"
        own = {scene.kind, "mixture"} if scene.species else {scene.kind}
        if not own & set(entry.kinds):
            several = ", ".join(n for n, o in OBSERVABLES.items() if own & set(o.kinds))
            raise checks.fail("observables", f"be of {scene.kind}s ({several})", repr(entry.name))
        if entry.wavenumbers and scene.by_species and entry.name != "band_energy":
            raise checks.fail("by_species", f"be False {of}", True)
        if entry.wavenumbers and scene.contact == "hertz":
            raise checks.fail("contact", f"be 'linear' {of}", repr(scene.contact))
        if entry.wavenumbers and scene.energy_definition == "bond" and scene.boundary == "fixed" and not scene.lattice:
            raise checks.fail("boundary", f"be 'periodic' {of} by 'bond'", repr(scene.boundary))
        if not entry.damped and scene.largest_damping > 0:
            raise checks.fail("damping", f"be zero {of}", scene.largest_damping)
