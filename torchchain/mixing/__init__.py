"""Energy that Hertz contacts carry between bands of frequency: triads, measured, fitted and solved."""

from torchchain.mixing.bands import FrequencyBands, frequency_band_energy
from torchchain.mixing.fit import TriadFit, fit_triads
from torchchain.mixing.master import NonlinearMasterEquation, spectrum_and_shapes
from torchchain.mixing.measure import Mixing, measure_mixing, random_phases
from torchchain.mixing.trajectories import TrajectoryLoss, fit_trajectories
from torchchain.mixing.triads import TriadModel, triads_of

__all__ = [
    "FrequencyBands", "Mixing", "NonlinearMasterEquation", "TrajectoryLoss", "TriadFit", "TriadModel", "fit_trajectories", "fit_triads",
    "frequency_band_energy", "measure_mixing", "random_phases", "spectrum_and_shapes", "triads_of",
]  # fmt: skip
