"""Wave energy in disordered granular chains: exact ensembles and the master equation calibrated from them.

Names are loaded on first use, so that the command line answers before torch is imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

_HOME = {
    "BandTransfer": "ensemble",
    "Chain": "chain",
    "Disorder": "disorder",
    "Impulse": "excitation",
    "Linearity": "evolvers.linearity",
    "LinearityWarning": "evolvers.linearity",
    "METHODS": "evolvers",
    "MasterEquation": "master",
    "MasterFamily": "master",
    "MemoryModel": "master",
    "NormalModes": "spectrum",
    "Plan": "planning",
    "RateModel": "master",
    "SOLVERS": "master",
    "Scaling": "scaling",
    "Scene": "scene",
    "SwingInModel": "master",
    "StandingWave": "excitation",
    "State": "excitation",
    "TrustWarning": "master",
    "Trajectory": "evolvers",
    "band_energy": "wavenumber",
    "band_transfer": "ensemble",
    "basis_fraction": "wavenumber",
    "bin_energy": "bands",
    "calibrate": "master",
    "calibrate_family": "master",
    "chapman_kolmogorov": "master",
    "count_modes_below": "localization",
    "energy_center": "energy",
    "energy_matrices": "energy",
    "energy_moments": "fused",
    "energy_width": "energy",
    "evolve": "evolvers",
    "implied_timescales": "master",
    "impulse": "excitation",
    "integrated_density_of_states": "localization",
    "kinetic_energy": "energy",
    "linearity": "evolvers.linearity",
    "long_time_band_energy": "wavenumber",
    "lyapunov_exponent": "localization",
    "normal_modes": "spectrum",
    "particle_energy": "energy",
    "plan": "planning",
    "potential_energy": "energy",
    "simulate": "ensemble",
    "standing_wave": "excitation",
    "statistical_distance": "statistics",
    "total_energy": "energy",
    "total_variation": "statistics",
    "wavenumber_energy": "wavenumber",
    "wavenumber_energy_matrix": "wavenumber",
    "weak_disorder_lyapunov": "localization",
    "zero_wavenumber_share": "wavenumber",
}

__all__ = sorted(_HOME)
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'torchchain' has no attribute '{name}'")
    value = getattr(import_module(f"torchchain.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
