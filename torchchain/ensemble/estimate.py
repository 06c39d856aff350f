"""The disorder of chains, read off their measured band energies by the theory."""

from __future__ import annotations

from torchchain import checks
from torchchain.chain.disorder import Disorder
from torchchain.ensemble.transfer import BandTransfer
from torchchain.theory.fit import DisorderFit, fit_disorder


def estimate_disorder(
    transfer: BandTransfer,
    n_particles: int | None = None,
    *,
    kind: str | None = None,
    lower: float | None = None,
    damping: bool = False,
    guess: float = 0.2,
) -> DisorderFit:
    """Strength of mass disorder (and contact damping) that explains a transfer best, with error bars.

    Nothing of the scene but its length, tones and law of the masses is looked at: the strength comes from the energies.
    For a single decay curve see :func:`torchchain.theory.fit_disorder`.

    Args:
        transfer: of rings, with at least 2 blocks of realizations.
        n_particles: N; None for that of the transfer's scene.
        kind, lower: law of the masses; None for the scene's, or normal and 0.05 without one.
        damping: fit contact damping too.
        guess: of the strength, from which the search starts.

    Returns:
        DisorderFit with strength, damping and their standard errors.

    Raises:
        FieldError: for a transfer with one block, or without a scene where ``n_particles`` is not given.

    >>> import torch, torchchain as tc
    >>> scene = tc.Scene(n_particles=64, n_bands=8, disorder=tc.Disorder(strength=0.2), realizations=40, times=[2.0, 5.0, 10.0])
    >>> found = tc.estimate_disorder(tc.band_transfer(scene))
    >>> abs(found.strength - 0.2) < 0.03
    True
    """
    checks.instance("transfer", transfer, BandTransfer)
    scene = transfer.scene
    if scene is not None and scene.lattice is not None:
        raise checks.fail("transfer", "be of chains", f"{scene.lattice} lattices")
    if n_particles is None:
        if scene is None:
            raise checks.fail("n_particles", "be given for a transfer without a scene", "None")
        n_particles = scene.n_particles
    law = Disorder() if scene is None else scene.disorder
    return fit_disorder(
        transfer.times, transfer.block_mean, n_particles, transfer.n_bands, None if scene is None else scene.tones,
        law.kind if kind is None else kind, law.lower if lower is None else lower, damping, guess,
    )  # fmt: skip
