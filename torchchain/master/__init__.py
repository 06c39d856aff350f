"""The stochastic master equation for the energy in wavenumber bands, its calibration and its file."""

from torchchain.master.adam import AdamReport, AdamSettings
from torchchain.master.calibration import calibrate
from torchchain.master.derived import TheoryModel
from torchchain.master.diagnostics import ChapmanKolmogorov, chapman_kolmogorov, implied_timescales
from torchchain.master.equation import MasterEquation, PredictionWarning
from torchchain.master.family import MasterFamily, calibrate_family
from torchchain.master.fits import AnalyticReport, FitWarning, NonlinearReport
from torchchain.master.ladder import MODELS, register_model
from torchchain.master.memory import MemoryModel, ProjectionReport, ProjectionSettings
from torchchain.master.model import Embedding, TransferModel
from torchchain.master.paper_rates import paper_rates
from torchchain.master.proof import Certificate
from torchchain.master.rates import RateModel, SwingInModel
from torchchain.master.records import Fit, NoSettings, Recipe, ReducedModel
from torchchain.master.report import Calibration, Loss, Report, Rung, Selection
from torchchain.master.sample import Sample
from torchchain.master.solving import SOLVERS, IntegrationError
from torchchain.master.starts import StartModel
from torchchain.master.uncertainty import Uncertainty

__all__ = [
    "MODELS", "SOLVERS", "AdamReport", "AdamSettings", "AnalyticReport", "Calibration", "Certificate",
    "ChapmanKolmogorov", "Embedding", "Fit", "FitWarning", "IntegrationError", "Loss", "MasterEquation", "MasterFamily", "MemoryModel",
    "NoSettings", "NonlinearReport", "PredictionWarning", "ProjectionReport", "ProjectionSettings", "RateModel",
    "Recipe", "ReducedModel", "Report", "Rung", "Sample", "Selection", "StartModel", "SwingInModel", "TheoryModel", "TransferModel",
    "Uncertainty", "calibrate", "calibrate_family", "chapman_kolmogorov", "implied_timescales", "paper_rates",
    "register_model",
]  # fmt: skip
