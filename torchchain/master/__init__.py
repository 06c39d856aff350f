"""The stochastic master equation for the energy in wavenumber bands, its calibration and its file."""

from torchchain.master.calibration import calibrate
from torchchain.master.equation import Calibration, MasterEquation
from torchchain.master.memory import MemoryModel
from torchchain.master.model import Embedding, RateModel, TransferModel
from torchchain.master.solvers import SOLVERS, IntegrationError

__all__ = [
    "SOLVERS",
    "Calibration",
    "Embedding",
    "IntegrationError",
    "MasterEquation",
    "MemoryModel",
    "RateModel",
    "TransferModel",
    "calibrate",
]
