"""Trajectories of other codes: LAMMPS, LIGGGHTS, MercuryDPM, extended XYZ."""

from torchchain.frames.motion import ContactUnits, check_energy
from torchchain.frames.reading import FORMATS, Frames, convert, read_frames
from torchchain.frames.record import Box, Contacts, Frame, FramesWarning
from torchchain.frames.registry import Format

__all__ = [
    "FORMATS",
    "Box",
    "ContactUnits",
    "Contacts",
    "Format",
    "Frame",
    "Frames",
    "FramesWarning",
    "check_energy",
    "convert",
    "read_frames",
]
