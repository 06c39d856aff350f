"""What there is: masses, contacts, disorder, units, states and trajectories."""

from torchchain.chain.amplitude import Linearity, LinearityWarning, linearity
from torchchain.chain.chain import BOUNDARIES, CONTACTS, Chain
from torchchain.chain.disorder import Disorder
from torchchain.chain.excitation import Impulse, StandingWave, impulse, standing_wave
from torchchain.chain.scaling import Scaling, UnitsWarning
from torchchain.chain.states import State, Trajectory

__all__ = [
    "BOUNDARIES", "CONTACTS", "Chain", "Disorder", "Impulse", "Linearity", "LinearityWarning", "Scaling",
    "StandingWave", "State", "Trajectory", "UnitsWarning", "impulse", "linearity", "standing_wave",
]  # fmt: skip
