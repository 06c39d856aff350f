"""The stochastic master equation for the energy in wavenumber bands, its calibration and its file."""

from torchchain.master.calibration import calibrate
from torchchain.master.diagnostics import ChapmanKolmogorov, chapman_kolmogorov, implied_timescales
from torchchain.master.equation import Calibration, MasterEquation, TrustWarning
from torchchain.master.family import MasterFamily, calibrate_family
from torchchain.master.memory import MemoryModel
from torchchain.master.model import Embedding, RateModel, SwingInModel, TransferModel
from torchchain.master.solvers import SOLVERS, IntegrationError
from torchchain.master.trust import Uncertainty

__all__ = [
    "SOLVERS",
    "Calibration",
    "ChapmanKolmogorov",
    "Embedding",
    "IntegrationError",
    "MasterEquation",
    "MasterFamily",
    "MemoryModel",
    "RateModel",
    "SwingInModel",
    "TransferModel",
    "TrustWarning",
    "Uncertainty",
    "calibrate",
    "calibrate_family",
    "chapman_kolmogorov",
    "implied_timescales",
]
