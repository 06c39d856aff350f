"""Trajectories of other codes: LAMMPS, LIGGGHTS, MercuryDPM, extended XYZ."""

from torchchain.frames.doubts import check_energy, check_opening
from torchchain.frames.files import convert, read_frames
from torchchain.frames.formats import FORMATS
from torchchain.frames.reading import Frames
from torchchain.frames.record import Box, Contacts, Frame, FramesWarning
from torchchain.frames.registry import Entry, Format, Raw, Scan
from torchchain.frames.units import ContactUnits

__all__ = [
    "FORMATS",
    "Box",
    "ContactUnits",
    "Contacts",
    "Entry",
    "Format",
    "Frame",
    "Frames",
    "FramesWarning",
    "Raw",
    "Scan",
    "check_energy",
    "check_opening",
    "convert",
    "read_frames",
]
