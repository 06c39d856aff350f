"""Band transfer from the disorder alone: the ladder at early times, localization at late ones, and an error estimate."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain import BOUNDARIES, CONTACTS, Disorder
from torchchain.energy.bands import center_tones, check_bands
from torchchain.theory.crossed import LAST, crossed_transfer
from torchchain.theory.ladder import DECAY, Waves, fading, ladder_transfer, spectrum_edges, stretches
from torchchain.theory.law import Law, law_of
from torchchain.theory.localized import (
    MEASURED,
    Frequencies,
    Return,
    first_part,
    interference,
    onset,
    source_frequencies,
)
from torchchain.theory.mean_wave import MOST_VALUES, mean_wave_energy
from torchchain.threads import single_thread

LATEST_TIME = 5000.0
"""Of damped chains, whose frequencies die out one after the other."""
FADING = 800.0
"""From here on what the ladder has not yet spread fades exponentially: each frequency has one rate, of leaving the tone."""
_MOST_TONES = 1024  # of the ring on which interference is added up: beyond it bands are wide against its features
_SLACK = 2e-4  # least share of definition "site", as in ensembles
_SHAPE_ERROR = 0.2  # part of the interference that its universal shape misses, measured
_ONSET_ERROR = 0.6  # part of a factor of two in its time of onset, likewise
_ROUNDING = 1e-9  # share of the energy below which what has been scattered is rounding


@dataclass(frozen=True, eq=False)
class TheoryTransfer:
    """Mean band energies of an ensemble from theory.

    Attributes:
        times: (time,).
        mean: share of the source's energy in each band, [source, time, receiver].
        long_time: the same averaged over infinite time, [source, receiver]; zero for damped chains.
        systematic: estimated total variation distance of ``mean`` from an endless ensemble, [source, time].
        long_time_systematic: of ``long_time``, (source,).
        settings: the grids that were chosen: edge of the spectrum, frequencies and damping of the contour a stretch of
            times; ``closure``, the largest defect of the energy sum before rows were scaled by it.

    Example:
        >>> found = tc.theory.theory_transfer(tc.Disorder(strength=0.3), n_particles=64, n_bands=8, times=[0.0, 10.0])
        >>> tuple(found.mean.shape), tuple(found.systematic.shape), tuple(found.long_time.shape)
        ((8, 2, 8), (8, 2), (8, 8))
    """

    times: Tensor
    mean: Tensor
    long_time: Tensor
    systematic: Tensor
    long_time_systematic: Tensor
    settings: dict[str, Any] = field(default_factory=dict)


def theory_transfer(
    disorder: Disorder,
    n_particles: int,
    n_bands: int,
    times: Any,
    tones: Sequence[int] | None = None,
    boundary: str = "periodic",
    stiffness_disorder: Disorder | None = None,
    contact: str = "linear",
    damping: float = 0.0,
    localization: bool = True,
    numbers: Return = MEASURED,
    decay: float = DECAY,
) -> TheoryTransfer:
    """Band transfer of a disordered ring without chains: conserving ladder, and localization (docs/theory.md).

    The energy is that of definition "site", relative to the source's at t = 0. It can be slightly negative, as an
    ensemble's mean is: -3e-4 at xi = 0.3 in both.

    Args:
        disorder: of the masses. Of strength 0 with a stiffness disorder: the dual chain, where compliances 1 / stiffness
            take the place of masses and tensions that of displacements.
        n_particles: N, even.
        n_bands: B.
        times: (time,); of damped chains up to 5000. The ladder beyond 400 is averaged over some 10 units of time around
            each, and beyond 800 what it has not yet spread fades as it did from 400 to 800.
        tones: one or more sources, counted from 1; None for the center tone of every band.
        boundary: "periodic"; plane waves are no modes of the mean fixed chain.
        stiffness_disorder: of the contacts; with equal masses alone.
        contact: "linear".
        damping: of the contacts; with mass disorder alone. It is exact: K becomes (1 - i damping z) K.
        localization: False for the ladder alone, which is right at early times and spreads energy without interference.
        numbers: of the enhanced return.
        decay: eta of the contour times the period of its grid, for tests of convergence.

    Returns:
        TheoryTransfer.

    Raises:
        FieldError: for what the theory does not hold for.

    Example:
        >>> from torchchain import Disorder
        >>> result = theory_transfer(Disorder(strength=0.2), 64, 8, [0.0, 1.0, 10.0])
        >>> result.mean.shape
        torch.Size([8, 3, 8])
    """
    times = checks.times("times", times).to(torch.float64)
    law, waves = described(
        disorder, n_particles, n_bands, tones, boundary, stiffness_disorder, contact, damping, float(times[-1])
    )
    checks.truth("localization", localization)
    return transfer_of_law(law, waves, times, localization, numbers, decay)


def transfer_of_law(
    law: Law, waves: Waves, times: Tensor, localization: bool = True, numbers: Return = MEASURED, decay: float = DECAY
) -> TheoryTransfer:
    """:func:`theory_transfer` of what :func:`described` made of its arguments; times (time,), to 5000."""
    n_bands, lossy, sources = waves.n_bands, waves.lossy, len(waves.sources)
    with single_thread(), torch.no_grad():
        edges = spectrum_edges(law)
        late = (times > FADING) & (not lossy)
        asked = (
            torch.cat([times[~late], times.new_tensor([FADING / 2, FADING])]).unique() if bool(late.any()) else times
        )
        ladder = ladder_transfer(law, waves, asked, edges, decay)
        total = ladder.sum(-1)
        closure = 0.0
        if not lossy:
            closure = float((total - 1).abs().max())
            ladder = ladder / total[..., None]
        mean = ladder[:, torch.searchsorted(asked, times.clamp(max=float(asked[-1])))]
        long_time = torch.zeros(sources, n_bands, dtype=torch.float64)
        long_error = torch.zeros(sources, dtype=torch.float64)
        error = torch.zeros(sources, len(times), dtype=torch.float64)
        early = times <= LAST
        crossed, coherent = torch.zeros(sources, len(times), n_bands, dtype=torch.float64), torch.zeros_like(error)
        if localization and bool(early.any()) and law.variance > 0:
            crossed[:, early], coherent[:, early] = crossed_transfer(law, waves, times[early], edges[0])
            if not lossy:  # rounding
                crossed[torch.arange(sources), :, waves.source_bands] -= crossed.sum(-1)
        sharp = localization and 1 < len(law.values) <= MOST_VALUES and isinstance(waves.ring, int)
        if sharp:
            medium, exact = mean_wave_energy(law, waves, times)
        fade = fading(times, LAST)
        for s, (plain, pattern, change, doubt, first) in enumerate(_returns(law, waves, times, edges[0], numbers)):
            if bool(late.any()):
                mean[s, late] = _faded(
                    ladder[s, torch.searchsorted(asked, asked[-1] / asked.new_tensor([2.0, 1.0]))], plain, times[late]
                )
            error[s] = doubt
            if localization:
                part = crossed_part(mean[s], crossed[s], first * fade, numbers)
                mean[s] += part[:, None] * crossed[s] + (1 - part)[:, None] * change
                if sharp:
                    _exchange(mean[s], int(waves.source_bands[s]), medium[s] + part * coherent[s], exact[s])
            else:
                error[s] += _distance(change)
            if not lossy:
                final = pattern.sum(-1)
                long_time[s] = plain + final if localization else plain
                long_error[s] = (_SHAPE_ERROR if localization else 1.0) * _distance(final)
    settings = {
        "edge": edges[0],
        "closure": closure,
        "stretches": stretches(float(asked[-1]), edges, decay, waves.momentum),
    }
    return TheoryTransfer(times, mean, long_time, error, long_error, settings)


def predicted_error(law: Law, waves: Waves, times: Tensor) -> Tensor:
    """``systematic`` of :func:`transfer_of_law` without the ladder, [source, time], in a fraction of its time."""
    with single_thread(), torch.no_grad():
        return torch.stack(
            [doubt for _, _, _, doubt, _ in _returns(law, waves, times, spectrum_edges(law)[0], MEASURED)]
        )


def _returns(
    law: Law, waves: Waves, times: Tensor, edge: float, numbers: Return
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]:
    """Of every source: at infinite time without interference, (band,); what interference changes, (band, node); what of
    it has come, (time, band); the estimated error, (time,); and the part that is still two particles', (time,)."""
    ring = _coarser(waves)
    k = (2 * torch.asin(waves.sources.sqrt() / 2)).tolist()
    for spectrum, wave in zip(source_frequencies(law, ring, edge), k, strict=True):
        plain, pattern = _patterns(ring, wave, spectrum, numbers)
        came, earlier = onset(times, spectrum, numbers), onset(2 * times, spectrum, numbers)
        left = torch.exp(-waves.damping * spectrum.nodes.square()[:, None] * times)
        change = (came * left).T @ pattern.T
        sooner = ((earlier - came) * left).T @ pattern.T
        doubt = _SHAPE_ERROR * _distance(change) + _ONSET_ERROR * _distance(sooner)
        yield plain, pattern, change, doubt, first_part(times, spectrum, numbers)


def _faded(ladder: Tensor, settled: Tensor, times: Tensor) -> Tensor:
    """Energies (time, band) after FADING, from those at half of it and at it, (2, band), which go to ``settled``."""
    rest = ladder - settled
    half, last = rest.abs().sum(-1).clamp(min=1e-12).tolist()
    rate = max(0.0, math.log(half / last)) / (FADING / 2)
    return settled + rest[1] * torch.exp(-rate * (times - FADING))[:, None]


def crossed_part(ladder: Tensor, crossed: Tensor, first: Tensor, numbers: Return) -> Tensor:
    """Part of the interference that is two particles', (time,): as far as it is a small correction, and bands have the energy
    (_SLACK aside); the rest is that of localized modes."""
    spare = ladder.clamp(min=0) + _SLACK
    room = torch.where(crossed < 0, spare / (-crossed).clamp(min=1e-300), math.inf).amin(-1)
    return torch.minimum(first / (1 + (_distance(crossed) / numbers.most) ** 4), room)


def _exchange(mean: Tensor, band: int, held: Tensor, exact: Tensor) -> None:
    """Give the mean wave (time,) in its band its exact energy, at the cost of bands in proportion to what has been scattered
    into them, (time, band), and never more than that."""
    mean[:, band] -= held
    scattered = mean.clamp(min=0)
    there = scattered.sum(-1)
    change = torch.minimum(exact - held, there) * (there > 0)
    mean -= (change / there.clamp(min=1e-300))[:, None] * scattered
    mean[:, band] += held + change


def _distance(change: Tensor) -> Tensor:
    return change.abs().sum(-1) / 2


def _patterns(ring: Waves, wave: float, spectrum: Frequencies, numbers: Return) -> tuple[Tensor, Tensor]:
    """Without interference, (band,), and what interference changes at each frequency, (band, node)."""
    plain = (spectrum.receivers @ spectrum.energy).reshape(ring.n_bands, -1).sum(-1)
    change = spectrum.receivers * interference(ring, wave, spectrum, numbers) * spectrum.energy
    return plain, change.reshape(ring.n_bands, -1, change.shape[-1]).sum(1)


def _coarser(waves: Waves) -> Waves:
    """The same bands on a ring of fewer tones."""
    if waves.n_particles <= 2 * _MOST_TONES:
        return waves
    n = 2 * waves.n_bands * max(1, _MOST_TONES // waves.n_bands)
    return Waves(n, waves.n_bands, waves.sources, waves.source_bands, waves.momentum, waves.damping)


def described(
    disorder: Disorder,
    n_particles: int,
    n_bands: int,
    tones: Sequence[int] | None,
    boundary: str,
    stiffness_disorder: Disorder | None,
    contact: str,
    damping: float,
    last: float = 0.0,
) -> tuple[Law, Waves]:
    """The law and the waves, with times up to ``last``; an error for what the theory does not hold for."""
    checks.instance("disorder", disorder, Disorder)
    checks.instance("stiffness_disorder", stiffness_disorder, Disorder, type(None))
    n_particles = checks.integer("n_particles", n_particles, 4)
    check_bands(n_particles, n_bands)
    checks.choice("boundary", boundary, BOUNDARIES)
    checks.choice("contact", contact, CONTACTS)
    damping = checks.number("damping", damping, at_least=0)
    if boundary != "periodic":
        raise checks.fail("boundary", "be 'periodic' for method 'theory', whose waves are a ring's", repr(boundary))
    if contact != "linear":
        raise checks.fail("contact", "be 'linear' for method 'theory'", repr(contact))
    if last > LATEST_TIME and damping > 0:
        raise checks.fail("times", f"be at most {LATEST_TIME:g} for method 'theory' of damped chains", last)
    soft = stiffness_disorder is not None and stiffness_disorder.strength > 0
    if soft and disorder.strength > 0:
        raise checks.fail("stiffness_disorder", "be without mass disorder for method 'theory'", stiffness_disorder)
    if soft and damping > 0:
        raise checks.fail("damping", "be 0 with stiffness disorder for method 'theory'", damping)
    found = center_tones(n_particles, n_bands) if tones is None else tuple(tones)
    if not found:
        raise checks.fail("tones", "hold at least one tone", "none")
    for tone in found:
        checks.integer("tones", tone, 1, n_particles // 2)
    law = law_of(stiffness_disorder).inverse() if soft and stiffness_disorder is not None else law_of(disorder)
    return law, Waves.of_tones(n_particles, n_bands, found, soft, damping)
