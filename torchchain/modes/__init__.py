"""Frequencies and shapes of linear chains; localization, density of states."""

from torchchain.modes.spectrum import DecompositionError, NormalModes, SpectrumWarning, normal_modes

__all__ = ["DecompositionError", "NormalModes", "SpectrumWarning", "normal_modes"]
