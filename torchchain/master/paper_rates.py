"""The paper's transfer rates Q with their standard error, labeled."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchchain import checks
from torchchain.ensemble.statistics import jackknife_error
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.diagnostics import without_one
from torchchain.master.fits import WINDOW, checked_window, linear_weights
from torchchain.master.sample import Sample, paper_basis

if TYPE_CHECKING:
    import xarray


def paper_rates(
    transfer: BandTransfer, window: tuple[float, float] = WINDOW, *, strength: float | None = None
) -> xarray.Dataset:
    """Q[s, r] of procedure L (Section 3.5): slope of the energy of band r per free energy of source s.

    Free is what Psi of Eq. 47 does not keep in its band. Of damped chains the slope is that of the distribution over
    bands. These are the rates that the paper shows in Figs. 16 and 17; see ``master.rates_meaning`` for those of a model.

    Args:
        transfer: see :func:`torchchain.band_transfer`.
        window: first and last time of the straight lines.
        strength: disorder xi; None for that of the transfer's scene.

    Returns:
        Dataset of ``rates`` and ``rates_stderr`` (source, receiver), per travel time of sound over one particle, with the
        bands counted from 1. Standard errors by jackknife over blocks of realizations, infinite for a single one.

    Raises:
        FieldError: for a window with less than two times, or where the strength is unknown.

    Example:
        >>> import torchchain as tc
        >>> scene = tc.Scene(n_particles=32, n_bands=4, realizations=8, times=[0, 0.5, 1, 1.5, 2])
        >>> q = tc.paper_rates(tc.band_transfer(scene))
        >>> float(q.rates.sel(source=3, receiver=3)) < 0
        True
    """
    checks.instance("transfer", transfer, BandTransfer)
    sample, window = Sample.of(transfer), checked_window(window)
    if strength is not None:
        sample = replace(sample, strength=checks.number("strength", strength, at_least=0))
    free = (1 - paper_basis(sample).diagonal()).clamp(min=torch.finfo(sample.mean.dtype).eps)[:, None]
    weights = linear_weights(transfer.times, window)
    used = weights.nonzero()[:, 0]

    def slopes(energy: torch.Tensor) -> torch.Tensor:
        energy = energy / energy.sum(-1, keepdim=True) if sample.damped else energy
        return weights[used] @ energy / free

    rates = slopes(transfer.mean[:, used])
    stderr = torch.full_like(rates, torch.inf)
    if len(transfer.block_counts) > 1:
        stderr = jackknife_error(torch.stack([slopes(mean[:, used]) for mean in without_one(transfer)]))
    bands = np.arange(1, transfer.n_bands + 1)
    unit = {"units": "1 / travel time of sound over one particle"}
    import xarray

    return xarray.Dataset(
        {
            "rates": (("source", "receiver"), rates.numpy(), {**unit, "long_name": "transfer rate Q, procedure L with Psi of Eq. 47"}),
            "rates_stderr": (("source", "receiver"), stderr.numpy(), {**unit, "long_name": "its standard error"}),
        },
        coords={
            "source": ("source", bands, {"long_name": "band s of the initial standing wave"}),
            "receiver": ("receiver", bands, {"long_name": "receiving band r"}),
        },
        attrs={"window": list(window), "disorder": float(sample.strength or 0.0)},
    )  # fmt: skip
