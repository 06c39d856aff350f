"""Wave energy in disordered granular chains: exact ensembles and the master equation calibrated from them.

Names are loaded on first use, so that the command line answers before torch is imported.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from torchchain._version import __version__ as __version__

_HOME = {
    "BandTransfer": "ensemble",
    "Advance": "evolvers",
    "Chain": "chain",
    "Disorder": "chain",
    "Impulse": "chain",
    "Linearity": "chain",
    "LinearityWarning": "chain",
    "METHODS": "evolvers",
    "MasterEquation": "master",
    "MasterFamily": "master",
    "Method": "evolvers",
    "MemoryModel": "master",
    "NormalModes": "modes",
    "Observable": "ensemble",
    "Plan": "ensemble.plan",
    "RateModel": "master",
    "SOLVERS": "master",
    "Scaling": "chain",
    "Scene": "ensemble",
    "SwingInModel": "master",
    "StandingWave": "chain",
    "State": "chain",
    "TrustWarning": "master",
    "Trajectory": "chain",
    "band_energy": "energy",
    "band_transfer": "ensemble",
    "basis_fraction": "energy",
    "bin_energy": "energy",
    "calibrate": "master",
    "calibrate_family": "master",
    "chapman_kolmogorov": "master",
    "count_modes_below": "modes.localization",
    "energy_center": "energy",
    "energy_matrices": "energy",
    "energy_moments": "ensemble.fused",
    "energy_width": "energy",
    "evolve": "evolvers",
    "implied_timescales": "master",
    "impulse": "chain",
    "integrated_density_of_states": "modes.localization",
    "kinetic_energy": "energy",
    "linearity": "chain",
    "long_time_band_energy": "energy",
    "lyapunov_exponent": "modes.localization",
    "normal_modes": "modes",
    "particle_energy": "energy",
    "paper_rates": "master",
    "plan": "master.stand_in",
    "register_model": "master",
    "potential_energy": "energy",
    "register_method": "evolvers",
    "register_observable": "ensemble",
    "simulate": "ensemble",
    "standing_wave": "chain",
    "statistical_distance": "ensemble.statistics",
    "total_energy": "energy",
    "total_variation": "ensemble.statistics",
    "wavenumber_energy": "energy",
    "wavenumber_energy_matrix": "energy",
    "weak_disorder_lyapunov": "modes.localization",
    "zero_wavenumber_share": "energy",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'torchchain' has no attribute '{name}'")
    value = getattr(import_module(f"torchchain.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
