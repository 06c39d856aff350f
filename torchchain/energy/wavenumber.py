"""Energy in wavenumber space, in bands, and its infinite-time average (Eqs. 42-47)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State, Trajectory
from torchchain.energy.bands import bin_energy, check_bands
from torchchain.energy.space import DEFINITIONS, EnergyMatrices, checked, positive, require_linear
from torchchain.modes.motion import change_basis, modal_amplitudes
from torchchain.modes.spectrum import NormalModes, modes_of, normal_modes


def wavenumber_energy(chain: Chain, trajectory: Trajectory, definition: str = "site") -> Tensor:
    """Energy at every |k| = 2 pi n / N, n = 0..N/2, the energies of k and -k added (Eq. 43).

    Args:
        chain: linear contacts.
        trajectory: displacement and velocity (*batch, time, particle).
        definition: "site" is the paper's diagonal of DFT TE DFT^-1 (Eq. 42), complex before k and -k are added,
            and slightly negative at times in a single realization. "bond" transforms sqrt(b) v and
            sqrt(kappa) times the elongation of the contacts: never negative. Both sum to the total energy.

    Returns:
        (*batch, time, N//2 + 1) in the unit of energy.

    Example:
        >>> chain = tc.Chain(torch.ones(16, dtype=torch.float64))
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=5), [0.0, 7.0], method="modes")
        >>> tc.wavenumber_energy(chain, path).argmax(-1).tolist()  # all in tone 5: no disorder, no transfer
        [5, 5]
    """
    checked(chain, trajectory)
    checks.choice("definition", definition, DEFINITIONS)
    require_linear(chain, "particle_energy, which is defined for every contact law")
    n = chain.n_particles
    displacement, velocity = trajectory.displacement, trajectory.velocity
    masses = chain.align(chain.masses, velocity)
    if definition == "site":
        moving = product(transform(masses * velocity), transform(velocity))
        if chain.is_uniform_ring:
            wave = transform(displacement)
            bound = wave_stiffness(chain) * product(wave, wave)
        else:
            displacement = chain.without_rigid_motion(displacement)
            bound = -product(transform(chain.force(displacement)), transform(displacement))
        energy = (moving + bound) / 2
    else:
        _require_ring(chain)
        elongation = chain.elongation(displacement)
        moved = transform(masses.sqrt() * velocity)
        stretched = transform(chain.align(chain.contact_stiffness, elongation).sqrt() * elongation)
        energy = (product(moved, moved) + product(stretched, stretched)) / 2
    # k and -k are added: twice the value, except where they are one wavenumber.
    energy[..., 1 : (n + 1) // 2] *= 2
    return checks.finite("energy of trajectory", energy, "wavenumber")


def _require_ring(chain: Chain) -> None:
    if not chain.is_free:  # N + 1 contacts on N wavenumbers: a transform of their own length would not fit
        raise checks.fail("boundary", "be 'periodic' for definition 'bond' in wavenumber space", repr(chain.boundary))


def wave_stiffness(chain: Chain) -> Tensor:
    """Stiffness 4 kappa sin^2(k / 2) at |k| = 2 pi n / N, n = 0..N/2, of a ring of equal contacts, (wavenumber,)."""
    n, masses = chain.n_particles, chain.masses
    k = 2 * math.pi / n * torch.arange(n // 2 + 1, dtype=masses.dtype, device=masses.device)
    return chain.contact_stiffness.flatten()[0] * 4 * torch.sin(k / 2).square()


def transform(field: Tensor) -> Tensor:
    """Unitary transform of a real field, (*any, wavenumber)."""
    return torch.fft.rfft(field, norm="ortho")


def product(a: Tensor, b: Tensor) -> Tensor:
    """Re(a conj(b)), without forming the imaginary part."""
    return a.real * b.real + a.imag * b.imag


def wavenumber_energy_matrix(matrices: EnergyMatrices) -> Tensor:
    """DFT TE DFT^-1 in full (Eq. 42), complex, (*batch, time, wavenumber, wavenumber), wavenumbers 2 pi (0..N-1) / N.

    Args:
        matrices: see :func:`energy_matrices`; N times the memory of what :func:`wavenumber_energy` needs.

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64))
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=2), [1.0], method="modes")
        >>> tuple(tc.wavenumber_energy_matrix(tc.energy_matrices(chain, path)).shape)
        (1, 8, 8)
    """
    checks.instance("matrices", matrices, EnergyMatrices)
    total = checks.real_tensor("matrices.total", matrices.total)
    n = total.shape[-1] if total.ndim > 1 else 0
    if n == 0 or total.shape[-2] != n:
        raise checks.fail("matrices.total", "be square on its last axes", total)
    index = torch.arange(n, device=total.device)
    angle = (-2 * math.pi / n) * ((index[:, None] * index) % n).to(total.dtype)
    dft = torch.polar(torch.full_like(angle, n**-0.5), angle)
    return torch.einsum("kp,...pq,mq->...km", dft, total.to(dft.dtype), dft.conj())


def band_energy(
    chain: Chain, trajectory: Trajectory, n_bands: int = 32, normalize: bool = True, definition: str = "site"
) -> Tensor:
    """Energy in each wavenumber band (Eqs. 44-46).

    Args:
        chain: linear contacts, an even number of particles.
        trajectory: (*batch, time, particle).
        n_bands: B equal bands of |k| in (0, pi].
        normalize: divide by the total energy, so that the bands and the share of k = 0 sum to 1.
        definition: see :func:`wavenumber_energy`.

    Returns:
        (*batch, time, band).

    Raises:
        FieldError: if the bands do not divide the tones, or a state to be normalized has no energy.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0))
        >>> path = tc.evolve(chain, tc.standing_wave(chain, tone=22), [0.0, 50.0], method="modes")
        >>> bands = tc.band_energy(chain, path, n_bands=8)
        >>> tuple(bands.shape), bands[0, 0].argmax().item() + 1  # tone 22 lies in band 6
        ((1, 2, 8), 6)
    """
    checked(chain, trajectory)
    checks.truth("normalize", normalize)
    check_bands(chain.n_particles, n_bands)
    energy = wavenumber_energy(chain, trajectory, definition)
    return _normalized(bin_energy(energy, n_bands), energy) if normalize else bin_energy(energy, n_bands)


def zero_wavenumber_share(chain: Chain, trajectory: Trajectory) -> Tensor:
    """Share of the total energy at k = 0, which no band holds, (*batch, time).

    Args:
        chain: linear contacts.
        trajectory: displacement and velocity (*batch, time, particle).

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64))
        >>> path = tc.evolve(chain, tc.impulse(chain), [0.0], method="modes")
        >>> round(tc.zero_wavenumber_share(chain, path).item(), 3)  # a kick moves the ring as a whole
        0.125
    """
    energy = wavenumber_energy(chain, trajectory)
    return _normalized(energy[..., :1], energy)[..., 0]


def _normalized(part: Tensor, energy: Tensor) -> Tensor:
    return part / positive(energy.sum(-1))[..., None]


def long_time_band_energy(
    chain: Chain,
    state: State,
    n_bands: int = 32,
    normalize: bool = True,
    modes: NormalModes | None = None,
    definition: str = "site",
) -> Tensor:
    """Infinite-time average of the band energies, exactly, from the modes: no time stepping.

    A mode of energy E_j, half kinetic and half potential on average, contributes E_j Re[(M s_j)^ conj(s_j^)]
    at each wavenumber (^: unitary DFT), since -K s_j = w_j^2 M s_j, and for "bond" E_j / 2 times the squares of
    (sqrt(b) s_j)^ and of (sqrt(kappa) times its elongations)^ / w_j. Modes of equal frequency, as the ordered ring
    or equal light beads far apart have, beat at no frequency and contribute their cross terms.

    Args:
        chain: linear contacts, undamped, an even number of particles.
        state: (*batch, *any, particle).
        n_bands: B.
        normalize: divide by the total energy.
        modes: the chain's NormalModes, where they are at hand.
        definition: see :func:`wavenumber_energy`.

    Returns:
        (*batch, *any, band).

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0))
        >>> late = tc.long_time_band_energy(chain, tc.standing_wave(chain, tone=22), n_bands=8)
        >>> tuple(late.shape), round(late.sum().item(), 2)
        ((1, 8), 1.0)
    """
    checks.instance("chain", chain, Chain)
    checks.instance("state", state, State)
    checks.truth("normalize", normalize)
    check_bands(chain.n_particles, n_bands)
    checks.choice("definition", definition, DEFINITIONS)
    require_linear(chain, "a time average of simulated band energies")
    modes = normal_modes(chain) if modes is None else modes_of(chain, modes)
    displacement, velocity = modal_amplitudes(chain, state, modes)
    frequency = chain.align(modes.frequencies, displacement)
    swing = frequency * displacement
    energy = (swing.square() + velocity.square()) / 2
    pairs = mode_transforms(chain, modes, definition)
    bands = change_basis(energy, mean_weight(pairs, n_bands))
    # Cross terms of modes of one frequency, those with the next mode, with the next but one, ... while there are any.
    step = modes.frequencies.diff(dim=-1)
    beside = step <= 64 * torch.finfo(step.dtype).eps * modes.frequencies[..., -1:]
    equal, d = beside, 1
    while checks.first(equal) is not None:
        cross = swing[..., d:] * swing[..., :-d] + velocity[..., d:] * velocity[..., :-d]
        cross = torch.where(chain.align(equal, cross), cross, torch.zeros_like(cross))
        upper = [(left[..., d:, :], right[..., :-d, :]) for left, right in pairs]
        lower = [(left[..., :-d, :], right[..., d:, :]) for left, right in pairs]
        weight = mean_weight(upper, n_bands) + mean_weight(lower, n_bands)
        bands = bands + change_basis(cross, weight) / 2
        equal, d = equal[..., :-1] & beside[..., d:], d + 1
    if not normalize:
        return bands
    total = energy.sum(-1, keepdim=True)
    positive(total[..., 0], "state")
    return bands / total


def mode_transforms(chain: Chain, modes: NormalModes, definition: str) -> list[tuple[Tensor, Tensor]]:
    """Pairs of transforms (*batch, mode, wavenumber); the mean of their products is where a mode's energy is."""
    shapes = modes.shapes.mT
    if definition == "site":
        return [(transform(chain.masses[..., None, :] * shapes), transform(shapes))]
    _require_ring(chain)
    moved = transform(chain.masses.sqrt()[..., None, :] * shapes)
    stretched = transform(chain.contact_stiffness.sqrt()[..., None, :] * chain.elongation(shapes))
    still = modes.frequencies[..., None] == 0  # the zero mode has kinetic energy alone
    stretched = torch.where(still, moved, stretched / modes.frequencies[..., None].masked_fill(still, 1))
    return [(moved, moved), (stretched, stretched)]


def mean_weight(pairs: list[tuple[Tensor, Tensor]], n_bands: int) -> Tensor:
    """Mean over the pairs of their products in bands, (*batch, mode, band)."""
    return torch.stack([_band_weight(left, right, n_bands) for left, right in pairs]).mean(0)


def _band_weight(moment: Tensor, wave: Tensor, n_bands: int) -> Tensor:
    """Re(moment conj(wave)) in bands, k and -k added, (*batch, mode, band)."""
    weight = product(moment, wave)
    weight[..., 1:-1] *= 2
    return bin_energy(weight, n_bands)


def basis_fraction(strength: float, n_bands: int) -> Tensor:
    """Psi(xi, r) for bands r = 1..B: the share of a band's energy that the paper holds back from transfer (Eq. 47).

    A postulate for low bands; the exact long-time share is :func:`long_time_band_energy` (at xi = 0.3 in band 10
    it is 0.55 where Psi is 0.19).

    Args:
        strength: xi.
        n_bands: B.

    Returns:
        (band,), between 0 and 1.

    Example:
        >>> [round(share, 3) for share in tc.basis_fraction(0.3, 32)[[0, 9, 31]].tolist()]
        [0.945, 0.186, 0.031]
    """
    strength = checks.number("strength", strength, at_least=0)
    band = torch.arange(1, checks.integer("n_bands", n_bands, 1, 10**6) + 1, dtype=torch.float64)
    uniform = 1 / n_bands
    return uniform + (1 - uniform) * torch.exp(-((strength * band / 2) ** 1.5))
