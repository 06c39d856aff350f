"""Ensembles: a scene, what is measured, how it is run, and what comes out with error bars."""

from torchchain.ensemble.observables import Observable, register_observable
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.simulation import simulate
from torchchain.ensemble.transfer import BandTransfer, Provenance, band_transfer

__all__ = ["BandTransfer", "Observable", "Provenance", "Scene", "band_transfer", "register_observable", "simulate"]
