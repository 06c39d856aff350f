"""Ensembles: a scene, what is measured, how it is run, and what comes out with error bars."""

from torchchain.ensemble.checkpoint import Checkpoint, CheckpointWarning
from torchchain.ensemble.contact_models import ContactModel
from torchchain.ensemble.estimate import estimate_disorder
from torchchain.ensemble.fused import EnergyMoments, energy_moments
from torchchain.ensemble.measured_transfer import band_transfer
from torchchain.ensemble.network_ensembles import network_transfer
from torchchain.ensemble.observables import OBSERVABLES, Observable, register_observable
from torchchain.ensemble.plan import Choice, Plan
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.ranks import Ranks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.simulation import SeamWarning, simulate
from torchchain.ensemble.stages import Stages
from torchchain.ensemble.starts import StartTransfer
from torchchain.ensemble.statistics import statistical_distance, total_variation
from torchchain.ensemble.transfer import BandTransfer

__all__ = [
    "OBSERVABLES", "BandTransfer", "Checkpoint", "CheckpointWarning", "Choice", "ContactModel", "EnergyMoments", "Observable",
    "Plan", "Provenance", "Ranks", "Scene", "SeamWarning", "Stages", "StartTransfer", "band_transfer", "energy_moments",
    "estimate_disorder", "network_transfer", "register_observable", "simulate", "statistical_distance", "total_variation",
]  # fmt: skip
