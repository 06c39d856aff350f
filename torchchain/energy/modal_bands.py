"""Band energies in time straight from the normal modes, in products of matrices alone: no states, no transforms per time."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.energy.bands import check_bands
from torchchain.energy.space import positive, require_linear
from torchchain.energy.wavenumber import transform, wave_stiffness
from torchchain.modes.motion import change_basis, modal_motion
from torchchain.modes.spectrum import NormalModes, normal_modes


def modal_band_energy(
    chain: Chain, state: State, times: Any, n_bands: int = 32, normalize: bool = True, modes: NormalModes | None = None
) -> Tensor:
    """What ``evolve`` with method "modes" and then ``band_energy`` (definition "site") give, in half of the time.

    The modes are transformed once, M s_j and s_j to wavenumber space. Each time's amplitudes then go through one product
    with the transforms, and their squares through one with the bands, which adds up real and imaginary parts, k and -k
    and the tones of a band together.

    Args:
        chain: linear contacts, undamped, an even number of particles, masses (*batch, particle).
        state: the start, (*batch, *any, particle).
        times: (time,).
        n_bands: B.
        normalize: divide by the total energy.
        modes: the chain's NormalModes, where they are at hand.

    Returns:
        (*batch, *any, time, band).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 2, 0))
        >>> state = tc.standing_wave(chain, tone=22)
        >>> quick = tc.energy.modal_band_energy(chain, state, [0.0, 50.0], n_bands=8)
        >>> torch.allclose(quick, tc.band_energy(chain, tc.evolve(chain, state, [0.0, 50.0], method="modes"), n_bands=8))
        True
    """
    width = check_bands(chain.n_particles, n_bands)
    require_linear(chain, "particle_energy, which is defined for every contact law")
    modes = normal_modes(chain) if modes is None else modes
    position, speed = modal_motion(chain, state, modes)(checks.times("times", times).to(state.displacement))
    wave, momentum = _real_transform(modes.shapes), _real_transform(chain.masses[..., :, None] * modes.shapes)
    tone = torch.arange(chain.n_particles // 2 + 1, device=wave.device)
    tone = torch.cat([tone, tone[1:-1]])  # of every column of the transforms
    # Half of the energy at k and half at -k, which are one at k = 0 and at the last tone; the last column is the total.
    weight = torch.where((tone == 0) | (2 * tone == chain.n_particles), 0.5, 1.0).to(wave)
    band = torch.nn.functional.one_hot((tone - 1).clamp(min=0) // width, n_bands).to(wave) * (tone > 0)[:, None]
    bins = weight[:, None] * torch.cat([band, torch.ones_like(band[:, :1])], dim=1)
    energy = (change_basis(speed, momentum) * change_basis(speed, wave)) @ bins
    shape = change_basis(position, wave)
    if chain.is_uniform_ring:
        energy = energy + shape.square() @ (wave_stiffness(chain)[tone, None] * bins)
    else:  # -K s_j = w_j^2 M s_j
        force = modes.frequencies.square()[..., :, None] * momentum
        energy = energy + (change_basis(position, force) * shape) @ bins
    bands = energy[..., :-1]
    return bands / positive(energy[..., -1])[..., None] if normalize else bands


def _real_transform(shapes: Tensor) -> Tensor:
    """Unitary DFT of every mode (*batch, particle, mode) as (*batch, mode, N): real parts, then imaginary parts but zero."""
    spectrum = transform(shapes.mT.contiguous())
    return torch.cat([spectrum.real, spectrum.imag[..., 1:-1]], dim=-1)
