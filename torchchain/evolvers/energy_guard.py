"""A guard for methods that step in time: the energy a chain keeps, plus what damping took, must stay what it was."""

from __future__ import annotations

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory


class EnergyDriftError(RuntimeError):
    """A time integration whose energy left the allowed range: its step or tolerance is too large."""


def check(chain: Chain, trajectory: Trajectory, initial: Tensor, allowed: Tensor | float, remedy: str) -> None:
    """An error where the energy kept and dissipated differs from the initial one by more than the fraction allowed.

    Args:
        chain: the chain of the trajectory.
        trajectory: the states to check.
        initial: energy at time 0, (*batch, *any).
        allowed: largest relative deviation, a number or (*batch, *any); an energy that is not a number never passes.
        remedy: what the user can do, for the message.

    Raises:
        EnergyDriftError: naming the realization and the time.
    """
    with torch.no_grad():
        allowed = torch.as_tensor(allowed, dtype=initial.dtype, device=initial.device).expand(initial.shape)
        energy = chain.energy(trajectory.displacement, trajectory.velocity)
        if trajectory.dissipated is not None:
            energy = energy + trajectory.dissipated
        change = (energy - initial[..., None]).abs()
        where = checks.first(~(change <= (allowed * initial)[..., None]))
        if where is None:
            return
        raise EnergyDriftError(
            f"energy must stay within {allowed[where[:-1]].item():.2g} of its initial {initial[where[:-1]].item():.4g}, got "
            f"{energy[where].item():.4g} at time {trajectory.times[where[-1]].item():g}"
            f"{checks.position(where[:-1])} ({remedy})"
        )
