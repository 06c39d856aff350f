# The public names: __all__ holds the everyday ones. The rest belong to the rooms, as tc.energy.bin_energy, and resolve here too.
from torchchain import chain as chain
from torchchain import energy as energy
from torchchain import ensemble as ensemble
from torchchain import evolvers as evolvers
from torchchain import frames as frames
from torchchain import master as master
from torchchain import mixing as mixing
from torchchain import modes as modes
from torchchain import network as network
from torchchain import species as species
from torchchain import theory as theory
from torchchain._version import __version__ as __version__
from torchchain.chain import Chain as Chain
from torchchain.chain import Disorder as Disorder
from torchchain.chain import Impulse as Impulse
from torchchain.chain import Linearity as Linearity
from torchchain.chain import LinearityWarning as LinearityWarning
from torchchain.chain import Scaling as Scaling
from torchchain.chain import StandingWave as StandingWave
from torchchain.chain import State as State
from torchchain.chain import Trajectory as Trajectory
from torchchain.chain import UnitsWarning as UnitsWarning
from torchchain.chain import impulse as impulse
from torchchain.chain import linearity as linearity
from torchchain.chain import standing_wave as standing_wave
from torchchain.checks import FieldError as FieldError
from torchchain.checks import FieldTypeError as FieldTypeError
from torchchain.energy import EnergyMatrices as EnergyMatrices
from torchchain.energy import basis_fraction as basis_fraction
from torchchain.energy import bin_energy as bin_energy
from torchchain.energy import energy_center as energy_center
from torchchain.energy import energy_matrices as energy_matrices
from torchchain.energy import energy_width as energy_width
from torchchain.energy import potential_energy as potential_energy
from torchchain.energy import start_energy as start_energy
from torchchain.energy import wavenumber_energy_matrix as wavenumber_energy_matrix
from torchchain.energy import zero_wavenumber_share as zero_wavenumber_share
from torchchain.ensemble import BandTransfer as BandTransfer
from torchchain.ensemble import Observable as Observable
from torchchain.ensemble import Provenance as Provenance
from torchchain.ensemble import Scene as Scene
from torchchain.ensemble import SeamWarning as SeamWarning
from torchchain.ensemble import band_transfer as band_transfer
from torchchain.ensemble import register_observable as register_observable
from torchchain.ensemble import simulate as simulate
from torchchain.ensemble.checkpoint import Checkpoint as Checkpoint
from torchchain.ensemble.checkpoint import CheckpointWarning as CheckpointWarning
from torchchain.ensemble.estimate import estimate_disorder as estimate_disorder
from torchchain.ensemble.fused import energy_moments as energy_moments
from torchchain.ensemble.observables import OBSERVABLES as OBSERVABLES
from torchchain.ensemble.plan import Plan as Plan
from torchchain.ensemble.statistics import statistical_distance as statistical_distance
from torchchain.ensemble.statistics import total_variation as total_variation
from torchchain.evolvers import METHODS as METHODS
from torchchain.evolvers import Advance as Advance
from torchchain.evolvers import Method as Method
from torchchain.evolvers import register_method as register_method
from torchchain.frames import Frames as Frames
from torchchain.frames import FramesWarning as FramesWarning
from torchchain.frames import read_frames as read_frames
from torchchain.master import MODELS as MODELS
from torchchain.master import SOLVERS as SOLVERS
from torchchain.master import Calibration as Calibration
from torchchain.master import ChapmanKolmogorov as ChapmanKolmogorov
from torchchain.master import Fit as Fit
from torchchain.master import FitWarning as FitWarning
from torchchain.master import IntegrationError as IntegrationError
from torchchain.master import MasterEquation as MasterEquation
from torchchain.master import MasterFamily as MasterFamily
from torchchain.master import MemoryModel as MemoryModel
from torchchain.master import PredictionWarning as PredictionWarning
from torchchain.master import RateModel as RateModel
from torchchain.master import Recipe as Recipe
from torchchain.master import ReducedModel as ReducedModel
from torchchain.master import Report as Report
from torchchain.master import SwingInModel as SwingInModel
from torchchain.master import TransferModel as TransferModel
from torchchain.master import Uncertainty as Uncertainty
from torchchain.master import calibrate as calibrate
from torchchain.master import calibrate_family as calibrate_family
from torchchain.master import chapman_kolmogorov as chapman_kolmogorov
from torchchain.master import implied_timescales as implied_timescales
from torchchain.master import paper_rates as paper_rates
from torchchain.master import register_model as register_model
from torchchain.master.equation import TrustWarning as TrustWarning
from torchchain.master.stand_in import plan as plan
from torchchain.modes import DecompositionError as DecompositionError
from torchchain.modes import NormalModes as NormalModes
from torchchain.modes import SpectrumWarning as SpectrumWarning
from torchchain.modes import localization as localization
from torchchain.modes.localization import count_modes_below as count_modes_below
from torchchain.modes.localization import integrated_density_of_states as integrated_density_of_states
from torchchain.modes.localization import lyapunov_exponent as lyapunov_exponent
from torchchain.modes.localization import weak_disorder_lyapunov as weak_disorder_lyapunov
from torchchain.network import Network as Network
from torchchain.network import lattice as lattice
from torchchain.network import packing as packing
from torchchain.network.energy import bond_energy as bond_energy
from torchchain.network.energy import kinetic_energy as kinetic_energy
from torchchain.network.energy import particle_energy as particle_energy
from torchchain.network.energy import total_energy as total_energy
from torchchain.network.systems import band_energy as band_energy
from torchchain.network.systems import evolve as evolve
from torchchain.network.systems import long_time_band_energy as long_time_band_energy
from torchchain.network.systems import normal_modes as normal_modes
from torchchain.network.systems import wavenumber_energy as wavenumber_energy
from torchchain.plots import plot_observable as plot_observable
from torchchain.results import RunFolder as RunFolder
from torchchain.results import open_folder as open

__all__ = [
    "BandTransfer",
    "Chain",
    "Disorder",
    "FieldError",
    "Frames",
    "Impulse",
    "MasterEquation",
    "Network",
    "Plan",
    "Scene",
    "StandingWave",
    "State",
    "Trajectory",
    "band_energy",
    "band_transfer",
    "calibrate",
    "energy_center",
    "energy_width",
    "estimate_disorder",
    "evolve",
    "impulse",
    "lattice",
    "long_time_band_energy",
    "normal_modes",
    "open",
    "packing",
    "paper_rates",
    "particle_energy",
    "plan",
    "read_frames",
    "register_method",
    "register_model",
    "register_observable",
    "simulate",
    "standing_wave",
]
