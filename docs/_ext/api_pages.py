"""The pages of the reference: every public name under its topic. A name that no topic lists fails the build and the test suite."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

TOPICS: dict[str, tuple[str, str]] = {
    "chains": (
        "Chains, disorder, starts",
        "Chain Disorder StandingWave Impulse standing_wave impulse State Trajectory Scaling linearity Linearity "
        "LinearityWarning UnitsWarning chain.BOUNDARIES chain.CONTACTS",
    ),
    "motion": (
        "Motion and modes",
        "evolve normal_modes NormalModes METHODS register_method Method Advance SpectrumWarning DecompositionError",
    ),
    "energy": (
        "Energy in space and in bands",
        "particle_energy kinetic_energy potential_energy total_energy bond_energy energy_matrices EnergyMatrices energy_center "
        "energy_width energy_moments wavenumber_energy wavenumber_energy_matrix zero_wavenumber_share band_energy "
        "bin_energy long_time_band_energy basis_fraction energy.band_of energy.center_tones energy.check_bands "
        "start_energy energy.StartEnergy energy.excited energy.kicked energy.kicked_band_energy energy.modal_band_energy energy.DEFINITIONS energy.band_energy energy.kinetic_energy energy.long_time_band_energy "
        "energy.particle_energy energy.total_energy energy.wavenumber_energy",
    ),
    "localization": (
        "Localization and density of states",
        "lyapunov_exponent weak_disorder_lyapunov integrated_density_of_states count_modes_below",
    ),
    "ensembles": (
        "Scenes, ensembles, plans",
        "Scene simulate plan Plan BandTransfer band_transfer Provenance estimate_disorder statistical_distance "
        "total_variation plot_observable register_observable Observable OBSERVABLES Checkpoint CheckpointWarning SeamWarning open RunFolder "
        "FieldError FieldTypeError ensemble.*",
    ),
    "master": (
        "Master equations",
        "calibrate MasterEquation calibrate_family MasterFamily paper_rates chapman_kolmogorov ChapmanKolmogorov "
        "implied_timescales MODELS SOLVERS register_model ReducedModel Fit Recipe TransferModel RateModel "
        "SwingInModel MemoryModel Calibration Report Uncertainty PredictionWarning FitWarning IntegrationError",
    ),
    "parts": ("Parts of a calibration", "master.*"),
    "theory": ("Theory", "theory.*"),
    "species": ("Mixtures of species", "species.*"),
    "mixing": ("Nonlinear contacts: energy that mixes bands", "mixing.*"),
    "frames": ("Frames of other codes", "read_frames Frames FramesWarning frames.*"),
    "networks": ("Networks: lattices and packings", "Network lattice packing network.* ensemble.network_transfer"),
}
ROOMS = ("chain", "energy", "ensemble", "frames", "master", "mixing", "network", "species", "theory")


def public_names() -> dict[str, Any]:
    """Every public object by the shortest name it has: those at the top, then those of the rooms."""
    top = importlib.import_module("torchchain")
    names = {name: getattr(top, name) for name in top._HOME if not inspect.ismodule(getattr(top, name))}
    names.pop("__version__", None)
    own = {id(value) for name, value in names.items() if getattr(value, "__name__", "") == name}
    names = {n: v for n, v in names.items() if id(v) not in own or v.__name__ == n}  # without earlier names
    known = {id(value) for value in names.values()}
    for room in ROOMS:
        module = importlib.import_module(f"torchchain.{room}")
        found = {name: getattr(module, name) for name in module.__all__}
        names |= {f"{room}.{name}": value for name, value in found.items() if id(value) not in known}
        known |= {id(value) for value in found.values()}
    return names


def by_topic() -> dict[str, list[str]]:
    """The public names of every topic; those that none lists by name or by room are under ''."""
    left = public_names()
    listed = {topic: words.split() for topic, (_, words) in TOPICS.items()}
    named = {word for words in listed.values() for word in words if not word.endswith("*")}
    pages: dict[str, list[str]] = {}
    for topic, words in listed.items():
        pages[topic] = [word for word in words if word in left]
        for room in (word[:-1] for word in words if word.endswith("*")):
            pages[topic] += sorted((n for n in left if n.startswith(room) and n not in named), key=str.lower)
    placed = {name for names in pages.values() for name in names}
    return pages | {"": sorted(set(left) - placed)}


def write_reference(target: Path) -> None:
    """One page for each topic, and their index."""
    target.mkdir(parents=True, exist_ok=True)
    names, pages = public_names(), by_topic()
    if missing := pages.pop(""):
        raise ValueError(f"TOPICS in {__file__} must list every public name, not {', '.join(missing)}")
    for topic, found in pages.items():
        title = TOPICS[topic][0]
        lines = [title, "=" * len(title), ""]
        for name in found:
            value = names[name]
            if inspect.isclass(value):
                lines += [f".. autoclass:: torchchain.{name}", "   :members:", ""]
            elif inspect.isfunction(value):
                lines += [f".. autofunction:: torchchain.{name}", ""]
            else:
                lines += [f".. py:data:: torchchain.{name}", "", f"   {_constant(value)}", ""]
        (target / f"{topic}.rst").write_text("\n".join(lines), encoding="utf-8")
    entries = "\n".join(f"   {topic}" for topic in pages)
    (target / "index.rst").write_text(
        "Reference by topic\n==================\n\nNames without a room are at the top, as ``tc.Chain``; the others "
        f"under their room, as ``tc.network.zone``.\n\n.. toctree::\n   :maxdepth: 2\n\n{entries}\n",
        encoding="utf-8",
    )


def _constant(value: Any) -> str:
    """A registry by its keys with their summaries, anything else as it is."""
    from pages import plain  # which needs docutils; the tests read TOPICS without it

    if isinstance(value, dict):
        words = {key: getattr(record, "summary", "") or getattr(record, "label", "") for key, record in value.items()}
        return "; ".join(f"``{key}``: {plain(said)}" if said else f"``{key}``" for key, said in words.items()) + "."
    return f"``{value!r}``"
