"""Normal modes of linear chains by batched eigen-decomposition (Eqs. 16-18)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchchain import checks
from torchchain.chain.chain import Chain


class SpectrumWarning(UserWarning):
    """Frequencies so far apart that the slow modes have lost half of their digits.

    Example:
        >>> issubclass(tc.SpectrumWarning, UserWarning)  # from normal_modes, where slow modes have few digits left
        True
    """


class DecompositionError(RuntimeError):
    """An eigen-solver returned modes that are not the chain's.

    Example:
        >>> issubclass(tc.DecompositionError, RuntimeError)  # the check of every decomposition raises it
        True
    """


@dataclass(frozen=True, eq=False)
class NormalModes:
    """Frequencies (*batch, mode), ascending, and shapes (*batch, particle, mode) with shapes^T M shapes = 1 (Eq. 17).

    Example:
        >>> modes = tc.normal_modes(tc.Chain(torch.ones(4, dtype=torch.float64)))
        >>> modes.frequencies.round(decimals=4).tolist(), tuple(modes.shapes.shape)
        ([0.0, 1.4142, 1.4142, 2.0], (4, 4))
    """

    frequencies: Tensor
    shapes: Tensor

    def __post_init__(self) -> None:
        for field in ("frequencies", "shapes"):
            object.__setattr__(self, field, checks.real_tensor(field, getattr(self, field)))
        checks.first_bad("frequencies", "not be negative", self.frequencies, self.frequencies < 0, "mode")


def modes_of(chain: Chain, modes: NormalModes) -> NormalModes:
    """The modes, checked to be those of the chain: shapes, and the products with one vector that they must give.

    Raises:
        FieldError: for modes of another chain.
    """
    checks.instance("modes", modes, NormalModes)
    batch, n = tuple(chain.batch_shape), chain.n_particles
    shapes, squared = modes.shapes, modes.frequencies.square()
    if tuple(shapes.shape) != (*batch, n, n) or tuple(squared.shape) != (*batch, n):
        raise checks.fail(
            "modes", f"have frequencies and shapes of {(*batch, n)} and {(*batch, n, n)}",
            f"{tuple(squared.shape)} and {tuple(shapes.shape)}",
        )  # fmt: skip
    if (shapes.dtype, shapes.device) != (chain.masses.dtype, chain.masses.device) or squared.dtype != shapes.dtype:
        raise checks.fail("modes", "have dtype and device of the chain", f"{shapes.dtype} on {shapes.device}")
    with torch.no_grad():
        vector = torch.cos(torch.arange(1, n + 1, dtype=shapes.dtype, device=shapes.device))
        image = shapes @ vector
        unit = (shapes.mT @ (chain.masses * image)[..., None])[..., 0] - vector
        linear = replace(chain, contact="linear")
        force = (shapes.mT @ linear.force(image)[..., None])[..., 0] + squared * vector
        limit = torch.finfo(shapes.dtype).eps ** 0.5
        good = (unit.abs().amax(-1) <= limit) & (force.abs().amax(-1) <= limit * squared.amax(-1))
        checks.first_bad("modes", "be those of the chain", unit.abs().amax(-1), ~good, "realization")
    return modes


def normal_modes(chain: Chain) -> NormalModes:
    """Normal modes of the linear (or linearized) chain, checked for residual and orthogonality.

    Solves the symmetric problem for M^(-1/2) K M^(-1/2). Each frequency is then taken anew from its mode's own
    elongations, w^2 = sum over contacts of kappa e^2, which is accurate relative to w itself where the solver's
    w^2 is accurate only relative to the largest. A periodic chain's zero mode is set exactly: w = 0, uniform.

    Args:
        chain: linear contacts, or Hertz contacts taken at the initial overlap.

    Returns:
        NormalModes, dtype and device of the masses.

    Raises:
        FieldError: if the chain is damped (its modes are not normal).
        DecompositionError: naming the first realization whose modes fail the check.
    """
    checks.instance("chain", chain, Chain)
    if chain.is_damped:
        raise checks.fail(
            "damping",
            "be zero for normal modes (use evolve's method 'damped')",
            f"up to {chain.contact_damping.max().item():g}",
        )
    weight = chain.masses.rsqrt()
    symmetric = chain.stiffness_matrix() * -weight[..., :, None] * weight[..., None, :]
    try:
        squared, vectors = torch.linalg.eigh(symmetric)
    except torch.linalg.LinAlgError as error:  # torch's own message names the member of the batch
        raise DecompositionError(
            f"masses and stiffnesses must leave the eigen-solver finite numbers, got: {error}"
        ) from None
    if symmetric.requires_grad and not checks.is_transformed(symmetric):
        symmetric.register_hook(lambda gradient: _check_gradient(gradient, squared.detach()))
    return checked_modes(chain, vectors)


def _check_gradient(gradient: Tensor, squared: Tensor) -> None:
    """An error where two modes of one frequency leave the eigenvectors without a derivative."""
    where = checks.first(~gradient.isfinite().all(-1).all(-1))
    if where is not None:
        gap = squared[where].diff()
        lower = int(gap.argmin())
        raise DecompositionError(
            f"modes must differ in frequency for a gradient of masses or stiffnesses, got squared frequencies "
            f"{squared[where][lower].item():.6g} of modes {lower + 1} and {lower + 2} that differ by "
            f"{gap[lower].item():.1e}{checks.position(where)} (method 'chebyshev' has the gradient)"
        )


def _warn_if_wide(squared: Tensor) -> None:
    """A :class:`SpectrumWarning` where rounding of the largest squared frequency is felt by the common ones, (*batch, mode)."""
    eps = torch.finfo(squared.dtype).eps
    middle = squared.sort(-1).values[..., squared.shape[-1] // 2]  # of two modes the upper: the lower can be at rest
    ratio = squared.amax(-1) / middle
    where = checks.first(eps * ratio > eps**0.5)
    if where is not None:
        warnings.warn(
            f"the highest squared frequency is {ratio[where].item():.1e} times the median{checks.position(where)}: rounding "
            f"leaves the other modes accurate to {eps * ratio[where].item():.1e} (method 'chebyshev' keeps more digits)",
            SpectrumWarning,
            stacklevel=4,
        )


def checked_modes(chain: Chain, vectors: Tensor) -> NormalModes:
    """NormalModes from orthonormal eigenvectors of M^(-1/2) K M^(-1/2), ascending, after checking them."""
    weight = chain.masses.rsqrt()
    if chain.is_free:
        # The zero mode is uniform; the others are made orthogonal to it, which the solver's error next to it is not.
        uniform = (chain.masses / chain.masses.sum(-1, keepdim=True)).sqrt()[..., None]
        others = vectors[..., 1:]
        others = others - uniform * (uniform.mT @ others)
        vectors = torch.cat([uniform, others], dim=-1)
    shapes = vectors * weight[..., :, None]
    across = shapes.mT.contiguous()  # (*batch, mode, particle)
    elongation = chain.elongation(across)
    tension = chain.contact_stiffness[..., None, :] * elongation
    squared = (tension * elongation).sum(-1)
    with torch.no_grad():  # in place: of fresh memory every page would cost as much as the arithmetic on it
        residual = chain.net(tension).mul_(weight[..., None, :])
        residual.add_((squared[..., :, None] * across).div_(weight[..., None, :]))
        residual = residual.abs_().amax((-2, -1))
        del tension, elongation, across
        gram = vectors.mT @ vectors
        gram.diagonal(dim1=-2, dim2=-1).sub_(1)
        orthogonality = gram.abs_().amax((-2, -1))
    limit = 40 * torch.finfo(shapes.dtype).eps * chain.n_particles**0.5
    where = checks.first(~((residual <= limit * squared.detach().amax(-1)) & (orthogonality <= limit)))
    if where is not None:
        raise DecompositionError(
            f"modes must satisfy the eigenvalue equation and orthogonality to {limit:.1e}, got residual "
            f"{residual[where].item():.1e} and orthogonality defect {orthogonality[where].item():.1e}"
            + checks.position(where)
        )
    _warn_if_wide(squared.detach())
    if chain.is_free:  # no square root of the zero mode: it has no derivative there
        frequencies = torch.cat([torch.zeros_like(squared[..., :1]), squared[..., 1:].sqrt()], dim=-1)
    else:
        frequencies = squared.sqrt()
    return NormalModes(frequencies, shapes)
