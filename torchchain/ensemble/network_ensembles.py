"""The band transfer of an ensemble of networks made from any one: a packing with other masses, stiffnesses, bonds, places."""

from __future__ import annotations

import hashlib
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.disorder import Disorder
from torchchain.ensemble.checkpoint import Checkpoint, Writer
from torchchain.ensemble.layout import BLOCKS
from torchchain.ensemble.measured_transfer import with_late_average
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.statistics import EnsembleMoments
from torchchain.ensemble.transfer import BandTransfer
from torchchain.ensemble.transfer_fields import of_moments
from torchchain.network import Network, PackingBands, packing_band_energy, packing_bands
from torchchain.network.disorder import disordered, displaced, kept_bonds, without_bonds
from torchchain.network.evolvers import begin
from torchchain.network.packing_bands import band_starts

WINDOW = 2e7  # numbers of the states held at once


def network_transfer(
    network: Network,
    times: Any,
    bands: PackingBands | int = 4,
    *,
    masses: Disorder | None = None,
    stiffness: Disorder | None = None,
    removed_bonds: float = 0.0,
    moved: float = 0.0,
    realizations: int = 100,
    seed: int = 0,
    method: str = "chebyshev",
    checkpoint: Checkpoint | str | Path | None = None,
) -> BandTransfer:
    """The transfer of energy between the bands of a network, averaged over an ensemble made from it.

    Every realization is the network with disorder of its own, and a wave starts in each of its bands
    (:func:`torchchain.network.band_starts`). Realization i of a seed is always the same, one is in memory at a time, and
    the means, errors and blocks are those of an ensemble of chains, so that :func:`torchchain.calibrate` takes it.

    Args:
        network: one network in a periodic box, without damping; rattlers had better be out
            (:func:`torchchain.network.without_rattlers`).
        times: (time,), from 0.
        bands: of :func:`torchchain.network.packing_bands`, or shells per polarization.
        masses, stiffness: what factors on masses and stiffnesses are drawn from.
        removed_bonds: probability that a bond is missing.
        moved: standard deviation of every coordinate of the particles, whose bonds rest at their new lengths.
        realizations: of the ensemble.
        seed: of all that is random.
        method: a name of ``torchchain.network.METHODS``.
        checkpoint: a folder that keeps finished realizations; the same call goes on from what is in it.

    Returns:
        BandTransfer with mean and stderr [source, time, receiver], its scene None; the long-time average is that over the
        later half of the times.

    Raises:
        FieldError: for a value out of range, a network without a box, a checkpoint of other settings.
        UnstableError: for a realization that its prestress makes unstable.

    Example:
        >>> sheet = tc.network.displaced(tc.lattice("triangular", (8, 8)), 0.1, seed=0)  # any network in a box
        >>> disorder = tc.Disorder(strength=0.3)
        >>> transfer = tc.ensemble.network_transfer(sheet, [0.0, 2.0, 9.0], 1, masses=disorder, realizations=4)
        >>> tuple(transfer.mean.shape), torch.allclose(transfer.mean.sum(-1), torch.ones(3, 3, dtype=torch.float64))
        ((3, 3, 3), True)
    """
    checks.instance("network", network, Network)
    if network.batch_shape:
        raise checks.fail("network", "be one network, without batch axes", tuple(network.batch_shape))
    if network.is_damped:
        raise checks.fail("damping", "be zero for a transfer of a network", "more")
    times = checks.times("times", times).double()
    if float(times[0]) != 0:
        raise checks.fail("times", "begin at 0", float(times[0]))
    realizations = checks.integer("realizations", realizations, 1, 10**9)
    removed_bonds = checks.number("removed_bonds", removed_bonds, at_least=0, below=1)
    moved = checks.number("moved", moved, at_least=0)
    seed = checks.integer("seed", seed, 0, 2**64 - 1)
    for name, law in (("masses", masses), ("stiffness", stiffness)):
        checks.instance(name, law, Disorder, type(None))
    if not isinstance(bands, PackingBands):
        bands = packing_bands(network, bands)
    settings = {
        "network": _digest(network), "times": times.tolist(), "bands": repr(bands), "masses": repr(masses),
        "stiffness": repr(stiffness), "removed_bonds": removed_bonds, "moved": moved, "realizations": realizations,
        "seed": seed, "method": method,
    }  # fmt: skip

    def draw(i: int) -> Network:
        made = displaced(network, moved, i, seed) if moved else network
        made = disordered(made, masses, stiffness, [i], seed)
        return without_bonds(made, kept_bonds(network.n_bonds, removed_bonds, [i], seed)) if removed_bonds else made

    def measured(i: int) -> Tensor:
        made = draw(i)
        state = band_starts(made, bands, i, seed)
        advance = begin(made, state, method)
        window = max(1, int(WINDOW / state.displacement.numel()))
        return torch.cat([packing_band_energy(made, advance(part), bands) for part in times.split(window)], dim=-2)

    if checkpoint is not None and not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    n_blocks = min(BLOCKS, realizations)
    writer: Writer | None = None
    with checkpoint.lock() if checkpoint is not None else nullcontext():
        moments = EnsembleMoments(realizations, n_blocks)
        if checkpoint is not None:
            kept = checkpoint.read(settings, realizations, n_blocks)
            moments, writer = kept.moments, checkpoint.writer(kept.session, 0, settings, None)
        done = {i for part in moments.held() for i in part}
        try:
            for i in range(realizations):
                if i not in done:
                    moments.add(i, {"band_energy": measured(i)})
                    if writer is not None and writer.due:
                        writer.save(moments)
        finally:
            if writer is not None:
                writer.close(moments)
    words = f"{realizations} networks of {network.n_particles} particles and {network.n_bonds} bonds, seed {seed}"
    provenance = Provenance("simulated", words, {"network": settings["network"]})
    attributes = {"bands": ", ".join(bands.labels), "largest_wavenumber": bands.largest}
    return with_late_average(BandTransfer(**of_moments(None, times, moments, attributes, provenance)))


def _digest(network: Network) -> str:
    """SHA-256 of all numbers of a network."""
    digest = hashlib.sha256(network.motion.encode())
    for name in ("masses", "positions", "bonds", "stiffness", "tension", "box", "anchors", "images"):
        value = getattr(network, name)
        digest.update(
            name.encode() if value is None else torch.as_tensor(value).detach().cpu().contiguous().numpy().tobytes()
        )
    return digest.hexdigest()
