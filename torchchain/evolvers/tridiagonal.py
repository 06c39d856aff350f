"""Exact evolution of a fixed chain by its normal modes, from LAPACK's tridiagonal eigen-solver."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain
from torchchain.chain.states import State
from torchchain.evolvers import modes
from torchchain.evolvers.method import Advance, Method
from torchchain.modes.spectrum import checked_modes


def vectors(chain: Chain) -> Tensor:
    """Orthonormal eigenvectors of the tridiagonal M^(-1/2) K M^(-1/2), frequencies ascending, (*batch, particle, mode)."""
    from scipy.linalg import eigh_tridiagonal  # takes a while to load

    stiffness, weight = chain.contact_stiffness, chain.masses.rsqrt()
    diagonal = (stiffness[..., :-1] + stiffness[..., 1:]) / chain.masses
    beside = -stiffness[..., 1:-1] * weight[..., 1:] * weight[..., :-1]
    n = chain.n_particles
    rows = zip(diagonal.cpu().reshape(-1, n).numpy(), beside.cpu().reshape(-1, n - 1).numpy(), strict=True)
    # Divide and conquer ("stevd") keeps the vectors orthogonal to rounding, which the default driver does not.
    solved = [eigh_tridiagonal(d, e, lapack_driver="stevd", check_finite=False)[1] for d, e in rows]
    return torch.from_numpy(np.stack(solved)).reshape(*chain.batch_shape, n, n).to(chain.masses)


def start(chain: Chain, state: State) -> Advance:
    """See the registry entry below."""
    for field in ("masses", "stiffness"):
        if torch.is_grad_enabled() and torch.as_tensor(getattr(chain, field)).requires_grad:
            raise checks.fail(
                field, "not require a gradient for method 'tridiagonal' (use 'modes')", "requires_grad=True"
            )
    return modes.start(chain, state, checked_modes(chain, vectors(chain)))


METHOD = Method(
    name="tridiagonal",
    start=start,
    summary="the modes of a fixed chain from LAPACK's tridiagonal solver, one chain after the other on the CPU",
    order="exact; the phase error grows as w t eps",
    conserves="energy of every mode",
    stability="unconditional",
    cost="as 'modes', with a decomposition several times faster from some hundred particles on",
    cannot="periodic chains, damping, Hertz contacts, gradients of masses and stiffness (those of the state it can)",
    boundaries=("fixed",),
    candidate=True,
    matrices=8,
    decomposition=(6.3e-8, 2e-11),
)
