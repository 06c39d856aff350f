"""The motion after a kick from the motion after a release, without evolving it.

Let c(t) be the matrix that takes the displacement at time 0 of a linear, undamped chain at rest to that at time t, so that
a release from u0 gives u = c u0 and v = c' u0. A kick v0 gives v = c v0 and u = s v0 with s' = c. As M c' = -K s, a chain
that is released from a displacement tells what it would do if the same numbers were its velocities: they move as the
displacement did, and the forces on them are the rate of change of momentum there.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import Trajectory
from torchchain.energy.bands import bin_energy, check_bands
from torchchain.energy.space import checked, require_linear
from torchchain.energy.wavenumber import band_energy, product, transform, wave_stiffness


def kicked(chain: Chain, trajectory: Trajectory) -> Trajectory:
    """The motion that starts undeformed, with velocities equal to the displacement from which this one was released at rest.

    Args:
        chain: linear contacts, undamped.
        trajectory: of a release at rest at time 0, (*batch, time, particle). Of a ring the motion as a whole is left
            out of the displacement.

    Returns:
        Trajectory of the same times.

    Raises:
        FieldError: for contacts that are not linear, or damped ones.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(16, 1, 0))
        >>> start = tc.standing_wave(chain, tone=3)
        >>> path = tc.energy.kicked(chain, tc.evolve(chain, start, [0.0, 9.0], method="modes"))
        >>> kick = tc.State(torch.zeros_like(start.displacement), start.displacement)
        >>> torch.allclose(path.velocity, tc.evolve(chain, kick, [0.0, 9.0], method="modes").velocity)
        True
    """
    _check(chain, trajectory)
    momentum = chain.align(chain.masses, trajectory.velocity) * trajectory.velocity
    # Tensions differ from contact to contact by the force on the particle between; elongations add up to nothing.
    pull = torch.nn.functional.pad(momentum.cumsum(-1), (1, 0))[..., : chain.n_contacts]
    softness = 1 / chain.align(chain.contact_stiffness, pull)
    shared = (pull * softness).sum(-1, keepdim=True) / softness.expand_as(pull).sum(-1, keepdim=True)
    place = ((pull - shared) * softness).cumsum(-1)[..., : chain.n_particles]
    return Trajectory(trajectory.times, chain.without_rigid_motion(place), trajectory.displacement)


def kicked_band_energy(
    chain: Chain, trajectory: Trajectory, n_bands: int = 32, normalize: bool = True, definition: str = "site"
) -> Tensor:
    """Energy in each wavenumber band of the motion that :func:`kicked` gives.

    Args:
        chain: linear contacts, undamped, an even number of particles.
        trajectory: of a release at rest at time 0, (*batch, time, particle).
        n_bands, normalize, definition: see :func:`torchchain.band_energy`.

    Returns:
        (*batch, time, band).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0))
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=22), [0.0, 50.0], method="modes")
        >>> tc.energy.kicked_band_energy(chain, path, n_bands=8)[0, 0].argmax().item() + 1
        6
    """
    if definition != "site" or not chain.is_uniform_ring:
        return band_energy(chain, kicked(chain, trajectory), n_bands, normalize, definition)
    _check(chain, trajectory)
    n = chain.n_particles
    check_bands(n, n_bands)
    masses = chain.align(chain.masses, trajectory.velocity)
    # of the velocities, and of the forces, by which the stiffness, diagonal in wavenumber, divides
    wave, moved, force = (
        transform(field)
        for field in (trajectory.displacement, masses * trajectory.displacement, masses * trajectory.velocity)
    )
    stiffness = wave_stiffness(chain)
    stiffness[0] = torch.inf
    energy = (product(moved, wave) + product(force, force) / stiffness) / 2
    energy[..., 1 : (n + 1) // 2] *= 2
    bands = bin_energy(energy, n_bands)
    return bands / energy.sum(-1, keepdim=True) if normalize else bands


def _check(chain: Chain, trajectory: Trajectory) -> None:
    checked(chain, trajectory)
    require_linear(chain, "evolve from the kick itself")
    if chain.is_damped:
        raise checks.fail("damping", "be 0 for the motion after a kick from that after a release", "damped contacts")
