"""Energy in space and in wavenumber bands straight from the stencil, without storing the states.

What ``evolve`` with method "chebyshev" and then ``particle_energy``, ``energy_center``, ``energy_width`` or
``band_energy`` give, for ensembles: each chain stays in cache from the first time to the last and leaves only its
observables behind. Tensors that the Numba kernels cannot treat go through those functions, a window of times after
the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.energy import space as energy
from torchchain.energy import wavenumber
from torchchain.energy.bands import check_bands
from torchchain.energy.kicked import kicked_band_energy
from torchchain.evolvers import start
from torchchain.evolvers.chebyshev import CompiledAdvance
from torchchain.evolvers.expansion import ROUNDING
from torchchain.threads import map_in_order, ranges, side_by_side

# Bytes of one field that a thread takes from the stencil through the transform at a time: what it holds stays in cache.
_BLOCK = 2**18


@dataclass(frozen=True, eq=False)
class EnergyMoments:
    """Total energy, its center R (Eq. 37) and mean squared width r^2 (Eq. 38), each (*batch, *any, time).

    The sums over particles p of E_p, p E_p and p^2 E_p are total, total * center and total * (width + center^2).

    Example:
        >>> chain = tc.Chain(torch.ones(8, dtype=torch.float64), "fixed")
        >>> found = tc.energy_moments(chain, tc.impulse(chain, site=4), [0.0])
        >>> found.center.tolist(), found.width.tolist()
        ([4.0], [0.0])
    """

    total: Tensor
    center: Tensor
    width: Tensor


def energy_moments(chain: Chain, state: State, times: Any, definition: str = "site", **options: Any) -> EnergyMoments:
    """Total, center and width of the energy of every output time.

    Args:
        chain: linear contacts, undamped, masses (*batch, particle).
        state: the start, (*batch, *any, particle).
        times: (time,), increasing, not negative; on a uniform grid the work halves.
        definition: "site" (Eq. 36) or "bond" (Eq. A3), see :func:`torchchain.potential_energy`.
        options: those of method "chebyshev"; without ``accuracy``, it is that of rounding.

    Returns:
        EnergyMoments, dtype and device of the state.

    Raises:
        FieldError: as ``evolve`` and ``energy_center`` do.

    Example:
        >>> chain = tc.Chain(tc.Disorder().masses(64, 1, 0), boundary="fixed")
        >>> moments = tc.energy_moments(chain, tc.impulse(chain), [0.0, 10.0, 20.0])
        >>> tuple(moments.center.shape), round(moments.center[0, 0].item(), 6)
        ((1, 3), 1.0)
    """
    checks.choice("definition", definition, energy.DEFINITIONS)
    times = checks.times("times", times)
    advance = start(chain, state, "chebyshev", **{"accuracy": ROUNDING, **options})
    shape = (*state.displacement.shape[:-1], len(times))
    if not isinstance(advance, CompiledAdvance):
        parts = []
        for window in _windows(times, state):
            here = energy.particle_energy(chain, advance(window), definition)
            parts.append(torch.stack([here.sum(-1), energy.energy_center(here), energy.energy_width(here)]))
        return EnergyMoments(*torch.cat(parts, dim=-1))
    from torchchain.evolvers import records, stencil

    kind = records.SITE_MOMENTS if definition == "site" else records.BOND_MOMENTS
    advance.check_work(times)
    rows_in_time, steps = stencil.Propagation(advance.rows, mirrored=True, once=True), times.double().numpy()
    out = np.empty((advance.rows.count, len(steps), 3))
    side_by_side(lambda begin, end: rows_in_time.moments(begin, end, steps, kind, out), advance.rows.count)
    moments = torch.from_numpy(out).to(state.displacement.dtype)
    total, center, width = moments.reshape(*shape, 3).unbind(-1)
    if not (out[..., 0] > 0).all():
        checks.first_bad("total energy", "be positive", total, ~(total > 0), "time")
    return EnergyMoments(total, center, width)


def band_energy(
    chain: Chain,
    state: State,
    times: Any,
    n_bands: int = 32,
    normalize: bool = True,
    definition: str = "site",
    **options: Any,
) -> Tensor:
    """Energy in each wavenumber band at every output time (Eqs. 44-46).

    Args:
        chain: linear contacts, undamped, an even number of particles, masses (*batch, particle).
        state: the start, (*batch, *any, particle), for instance an axis of tones.
        times: (time,), increasing, not negative; on a uniform grid the work halves.
        n_bands, normalize, definition: as in :func:`torchchain.band_energy`.
        options: those of method "chebyshev"; without ``accuracy``, it is that of rounding.

    Returns:
        (*batch, *any, time, band), dtype and device of the state.

    Raises:
        FieldError: as ``evolve`` and ``band_energy`` do.
    """
    checks.choice("definition", definition, energy.DEFINITIONS)
    check_bands(chain.n_particles, n_bands)
    times = checks.times("times", times)
    advance = start(chain, state, "chebyshev", **{"accuracy": ROUNDING, **options})
    if definition == "bond" and chain.boundary != "periodic":
        raise checks.fail("boundary", "be 'periodic' for definition 'bond' in wavenumber space", repr(chain.boundary))
    if not isinstance(advance, CompiledAdvance):
        paths = map(advance, _windows(times, state))
        return torch.cat([wavenumber.band_energy(chain, p, n_bands, normalize, definition) for p in paths], dim=-2)
    from torchchain.evolvers import records

    kind, count, strain = records.BOND_FIELDS, 2, np.zeros(chain.n_particles // 2 + 1)
    if definition == "site":
        kind, count = (records.UNIFORM_FIELDS, 3) if chain.is_uniform_ring else (records.SITE_FIELDS, 4)
        strain = _strain(chain)
    (bands,) = _binned(advance, state, times, n_bands, normalize, kind, count, [(kind, strain)])
    return bands


def both_band_energies(
    chain: Chain, state: State, times: Any, n_bands: int = 32, **options: Any
) -> tuple[Tensor, Tensor]:
    """Shares of the energy in bands after a release, and after a kick of the same shape, at every output time.

    What :func:`band_energy` gives, and :func:`torchchain.energy.kicked_band_energy` from the same motion.

    Args:
        chain: a uniform ring, undamped, masses (*batch, particle).
        state: at rest, (*batch, *any, particle).
        times, n_bands, options: see :func:`band_energy`.

    Returns:
        Two of (*batch, *any, time, band), dtype and device of the state.
    """
    check_bands(chain.n_particles, n_bands)
    times = checks.times("times", times)
    advance = start(chain, state, "chebyshev", **{"accuracy": ROUNDING, **options})
    if not isinstance(advance, CompiledAdvance):
        parts = [
            (wavenumber.band_energy(chain, here, n_bands), kicked_band_energy(chain, here, n_bands))
            for here in map(advance, _windows(times, state))
        ]
        released, struck = (torch.cat(part, dim=-2) for part in zip(*parts, strict=True))
        return released, struck
    from torchchain.evolvers import records

    strain = _strain(chain)
    softness = np.divide(1.0, strain, out=np.zeros_like(strain), where=strain > 0)
    wanted = [(records.UNIFORM_FIELDS, strain), (records.KICKED_FIELDS, softness)]
    released, struck = _binned(advance, state, times, n_bands, True, records.KICKED_FIELDS, 4, wanted)
    return released, struck


def _strain(chain: Chain) -> np.ndarray:
    """Stiffness 4 kappa sin^2(k / 2) of each wavenumber, (N/2 + 1,), of a uniform ring of even N."""
    n = chain.n_particles
    return float(chain.contact_stiffness.flatten()[0]) * 4 * np.sin(math.pi / n * np.arange(n // 2 + 1)) ** 2


def _binned(
    advance: CompiledAdvance, state: State, times: Tensor, n_bands: int, normalize: bool, kind: int, count: int,
    wanted: list[tuple[int, np.ndarray]],
) -> list[Tensor]:  # fmt: skip
    """Energies in bands, (*batch, *any, time, band), of each of the wanted kinds.

    Args:
        advance: from the state at time 0.
        state, times, n_bands, normalize: see :func:`band_energy`.
        kind, count: of the fields that are transformed.
        wanted: kinds of energy with their strain, as :func:`torchchain.evolvers.spectra.bin_spectra` takes them.
    """
    from torchchain.evolvers import stencil
    from torchchain.evolvers.spectra import bin_spectra

    advance.check_work(times)
    steps, rows = times.double().numpy(), advance.rows
    n = rows.masses.shape[1]
    window = min(len(steps), max(1, _BLOCK // (8 * n)))
    size = min(rows.count, max(1, _BLOCK // (8 * n * window)))
    strains = [np.repeat(strain, 2) for _, strain in wanted]  # of the real and of the imaginary part
    rows_in_time = stencil.Propagation(rows, mirrored=True, once=window == len(steps))
    bands = [np.empty((rows.count, len(steps), n_bands)) for _ in wanted]
    totals = [np.empty((rows.count, len(steps))) for _ in wanted]

    def work(part: tuple[int, int]) -> None:
        # Little Python a block: a thread that waits for another's is slow to wake.
        begin, end = part
        fields = torch.empty((count, 0, 0, n), dtype=torch.float64)
        for low in range(begin, end, size):
            high = min(low + size, end)
            for first in range(0, len(steps), window):
                last = min(first + window, len(steps))
                if fields.shape[1:3] != (high - low, last - first):
                    fields = torch.empty((count, high - low, last - first, n), dtype=torch.float64)
                rows_in_time.fields(low, high, steps[first:last], kind, fields.numpy(), low)
                spectra = torch.fft.rfft(fields).numpy().view(np.float64)
                for (what, _), strain, found, total in zip(wanted, strains, bands, totals, strict=True):
                    bin_spectra(spectra, what, strain, normalize, low, first, found, total)
                del spectra  # so that the next lie where these do, in cache

    workers = min(torch.get_num_threads(), rows.count)
    for _ in map_in_order(work, ranges(rows.count, workers), workers):
        pass
    shape = (*state.displacement.shape[:-1], len(steps))
    for each in totals if normalize else []:
        if not (each > 0).all():
            total = torch.from_numpy(each).reshape(shape)
            checks.first_bad("total energy", "be positive to normalize", total, ~(total > 0), "time")
    return [torch.from_numpy(found).reshape(*shape, n_bands).to(state.displacement.dtype) for found in bands]


def _windows(times: Tensor, state: State) -> tuple[Tensor, ...]:
    """Windows of times whose states fit in some 100 MB."""
    return times.to(state.displacement.device).split(max(1, 2**23 // state.displacement.numel()))
