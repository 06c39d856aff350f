"""What of a scene a master equation was not calibrated for, in words."""

from __future__ import annotations

from torchchain.chain.excitation import StandingWave
from torchchain.ensemble.scene import Scene
from torchchain.master.starts import StartModel

COMPARED = (
    "lattice", "shape", "motion", "removed_bonds", "position_disorder", "species", "arrangement", "unlike", "by_species",
    "boundary", "damping", "contact", "energy_definition",
)  # fmt: skip
"""Fields of a scene that must be those of the calibration."""


def differences(scene: Scene, own: Scene, starts: StartModel | None) -> list[str]:
    """How a scene differs from the one of the calibration, in words; empty if in nothing that matters."""
    found = [
        f"{name} {getattr(scene, name)}, calibrated on {getattr(own, name)}"
        for name in COMPARED
        if getattr(scene, name) != getattr(own, name)
    ]
    masses = (scene.disorder.kind, own.disorder.kind)
    if masses[0] != masses[1] or scene.stiffness_disorder != own.stiffness_disorder:
        found.append("another kind of disorder")
    for name in ("strength", "lower"):
        here, there = (float(getattr(other.disorder, name)) for other in (scene, own))
        if abs(here - there) > 1e-9:
            found.append(f"disorder {name} {here:g}, calibrated on {there:g}".replace(" strength", ""))
    shorter = min(scene.n_particles, own.n_particles)
    if scene.n_particles != own.n_particles and float(scene.times[-1]) > shorter:
        found.append(
            f"{scene.n_particles} particles, calibrated on {own.n_particles}, and waves that go round by t = {shorter}"
        )
    if starts is not None and scene.n_particles == starts.n_particles:
        return found  # any start will do
    return [*found, *_other_start(scene, own)]


def _other_start(scene: Scene, own: Scene) -> list[str]:
    """How the start of a scene differs from the standing waves of the calibration, in words."""
    wave, known = scene.excitation, own.excitation
    assert isinstance(known, StandingWave), "transfers come from standing waves"
    if not isinstance(wave, StandingWave):
        return ["an impulse, calibrated on standing waves"]
    found = []
    if scene.contact != "linear" and wave.amplitude != known.amplitude:  # of linear chains it does not matter
        found.append(f"amplitude {wave.amplitude:g}, calibrated on {known.amplitude:g}")
    if wave.phase != known.phase and scene.boundary != "periodic":  # on a ring they are the same on average
        found.append(f"phase {wave.phase}, calibrated on {known.phase}")
    places = {round(_place(tone, own), 9) for tone in own.tones}
    others = [tone for tone in scene.tones if round(_place(tone, scene), 9) not in places]
    if others:
        found.append(f"tone {others[0]} of {scene.n_particles} particles, no tone of the calibration")
    return found


def _place(tone: int, scene: Scene) -> float:
    """Wavenumber of a tone, 1 for pi."""
    return 2 * tone / scene.n_particles
