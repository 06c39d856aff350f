"""States of networks in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from torchchain import checks
from torchchain.chain.states import Trajectory
from torchchain.network.networks import Network


@dataclass(frozen=True, eq=False)
class NetworkTrajectory(Trajectory):
    """States of networks in time: displacement and velocity (*batch, *any, time, particle, component).

    Attributes:
        times: (time,).
        dissipated: energy lost to damping since time 0, (*batch, *any, time); None if undamped.
        openings: contacts open up to each time, (*batch, *any, time); None for linear contacts.

    Example:
        >>> sheet = tc.lattice("triangular", (4, 4))
        >>> path = tc.evolve(sheet, tc.network.plane_wave(sheet, (1, 0)), [0.0, 1.0], method="modes")
        >>> tuple(path.displacement.shape)
        (2, 16, 2)
    """

    axes_of_a_state: ClassVar[tuple[str, ...]] = ("particle", "component")


def check_trajectory(network: Network, trajectory: Trajectory) -> tuple[Tensor, Tensor]:
    """Displacement and velocity, if they are states in time of this network."""
    checks.instance("network", network, Network)
    checks.instance("trajectory", trajectory, Trajectory)
    network.check_state(trajectory.displacement)
    if trajectory.displacement.ndim < len(network.batch_shape) + 3:
        raise checks.fail(
            "trajectory",
            "have the axes (*batch, time, particle, component)",
            trajectory.displacement,
        )
    return trajectory.displacement, trajectory.velocity
