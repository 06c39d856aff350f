"""Ensembles: a scene, what is measured, how it is run, and what comes out with error bars."""

from torchchain.ensemble.scene import Scene
from torchchain.ensemble.simulation import simulate
from torchchain.ensemble.transfer import BandTransfer, band_transfer

__all__ = ["BandTransfer", "Scene", "band_transfer", "simulate"]
