"""A model of a few hundred numbers, whatever the number of bands, never negative and exact at early times by its form.

The odds of finding energy of band s in band r rather than still in s are those of two waves of an effective medium that beat
and decay, times the exponential of a smooth function of place, distance and time:

    T[s, r](t) = o_sr / (own_s + sum_r' o_sr'),   o_sr = D_sr(t) exp(p(u, v, tau)),   own_s = exp(q(s, tau)).

D is second-order perturbation theory, damped, summed over the tones of the receiving band (:mod:`torchchain.master.waves`).
p and q are polynomials of Legendre, of the mean wavenumber u, the logarithm v of the distance
in units of the decay, and a clock tau = sqrt(t) / (sqrt(t) + sqrt(t0)) that shows 1 at infinity. Their coefficients are all
that is fitted: a logistic regression, by Levenberg's and Marquardt's method.
"""

from __future__ import annotations

import copy
import math
from dataclasses import fields
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.certificate import CertificateError
from torchchain.master.loss import frequencies, mode_energy
from torchchain.master.memory import ORDERS, MemoryModel, checked_order, fit_memory
from torchchain.master.model import Embedding, TransferModel, checked_square
from torchchain.master.nonnegative import nonnegative
from torchchain.master.polynomials import checked_degrees, factors, n_coefficients, shapes
from torchchain.master.proof import Certificate
from torchchain.master.waves import Waves, all_odds

LOWEST_SHARE = -1e-6
"""Least energy, of the whole, of a model with memory that stands for another where no certified one is found."""


class OddsModel(TransferModel):
    """A transfer of positive odds over their sum, at any time from 0 to infinity: not the solution of a linear equation.

    For any coefficients nothing is negative, and rows add up to 1 or, of damped chains, to what is left of the energy.

    Attributes:
        coefficients: what is fitted, (term,).
    """

    rates_meaning: ClassVar[str] = MemoryModel.rates_meaning
    has_equation: ClassVar[bool] = False
    conservation_defect = 0.0  # rows are divided by their sum
    coefficients: Tensor

    @property
    def damped(self) -> bool:
        """Whether the energy falls to zero."""
        raise NotImplementedError

    @property
    def certificate(self) -> Certificate:
        """By construction, for every t >= 0."""
        rounding = 2 * self.n_bands * torch.finfo(self.coefficients.dtype).eps
        return Certificate(0.0, 1.0 + rounding, math.inf if self.damped else rounding, 0.0, 0)

    @property
    def damping(self) -> Tensor:  # type: ignore[override]
        """None on top of the model's own, [band]."""
        return self.coefficients.new_zeros(self.n_bands)

    def as_memory(self, order: tuple[int, int] = (4, 6), span: float = 1e3) -> MemoryModel:
        """The nearest model with memory, certified if undamped: exponentials for whoever needs a linear differential equation.

        Where no order has one that is never negative, the least negative, if its energies are above -1e-6 of the whole.

        Args:
            order: numbers of exponentials and of pairs, or the next smaller ones with which a model is never negative.
            span: last time at which the two are compared.

        Raises:
            CertificateError: if there is none of any order.
        """
        times = torch.cat([
            torch.linspace(0.25, 5, 20, dtype=torch.float64), torch.logspace(math.log10(5.3), math.log10(span), 90, dtype=torch.float64),
        ])  # fmt: skip
        own = self if self.coefficients.dtype == torch.float64 else copy.deepcopy(self).double()
        with torch.no_grad():
            mean, basis = own.transfer(times), own.basis
        order = checked_order(order, len(times))
        near: list[tuple[float, MemoryModel]] = []
        for smaller in (order, *(known for known in ORDERS[::-1] if sum(known) < sum(order))):
            found = MemoryModel(rates=own.rates, **fit_memory(times, mean, basis, smaller)[0])
            if self.damped:  # what decays to nothing has no long-time energy to stay above of
                return found
            try:
                return nonnegative(found, times, mean)[0]
            except CertificateError as error:
                reason = error
                if error.nearest is not None and error.nearest[1].lower > LOWEST_SHARE:
                    near.append((error.nearest[1].lower, error.nearest[0]))
        if near:
            return max(near, key=lambda each: each[0])[1]
        raise reason

    def embedding(self) -> Embedding:
        """That of the nearest model with memory (:meth:`as_memory`): these odds obey no linear equation of their own."""
        return self.as_memory().embedding()


class CompactModel(OddsModel):
    """T[s, r](t) = o_sr / (own_s + sum o_sr'): odds of a damped beat times the exponential of polynomials (see the module).

    For every t >= 0 and any coefficients no entry is negative, every row adds up to 1, T(0) = I, and T(t) - I starts as t^4:
    odds are a positive D times an exponential of a bounded exponent (+-60), the own band's are an
    exponential alone, so that the sum which a row is divided by is positive; and D(0) = 0. Of damped chains these are
    shares of what is left of the energy, which :mod:`torchchain.master.loss` describes.

    Args:
        rates: Q [source, receiver] of the linear procedure at short times, for comparison.
        degrees: of the polynomials in place, distance and time, (3,).
        coefficients: of :func:`torchchain.master.polynomials.terms`, p first, (term,).
        waves: as tensors of :class:`Waves`.
        loss: of damped chains, weight of modes in what is left of the energy of each source, (band, mode); else (band, 0).
        contact_damping: of a contact of stiffness 1.
        guide: of members of a family, what the theory of disorder says of the coefficients, (term,); else (0,).
    """

    kind: ClassVar[str] = "compact"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {
        "rates": ("band", "band"), "degrees": ("degree",), "coefficients": ("term",), "source_frequency": ("band",),
        "source_decay": ("band",), "tone_frequency": ("band", "tone"), "tone_decay": ("band", "tone"), "coupling": (),
        "loss": ("band", "mode"), "contact_damping": (), "guide": ("term",),
    }  # fmt: skip
    optional: ClassVar[tuple[str, ...]] = ("guide",)
    loss: Tensor
    contact_damping: Tensor
    guide: Tensor
    _rates: Tensor

    def __init__(
        self, rates: Tensor, degrees: Tensor, coefficients: Tensor, source_frequency: Tensor, source_decay: Tensor,
        tone_frequency: Tensor, tone_decay: Tensor, coupling: Tensor, loss: Tensor | None = None,
        contact_damping: Tensor | None = None, guide: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        rates = checked_square(rates)
        n = len(rates)
        self.degrees_ = checked_degrees([int(value) for value in checks.real_tensor("degrees", degrees).flatten()])
        found = {
            "source_frequency": (source_frequency, (n,)), "source_decay": (source_decay, (n,)),
            "tone_frequency": (tone_frequency, (n, *tone_frequency.shape[1:2])),
            "tone_decay": (tone_decay, (n, *tone_frequency.shape[1:2])), "coupling": (coupling, ()),
            "coefficients": (coefficients, (n_coefficients(self.degrees_),)),
        }  # fmt: skip
        for name, (value, shape) in found.items():
            value = checks.shaped(name, value, shape).to(rates)
            if 0 in shape:
                raise checks.fail(name, "hold a tone", f"shape {shape}")
            if name != "coefficients":
                checks.first_bad(name, "be positive", value, ~(value > 0), "band")
            self._hold(**{name: value})
        loss = rates.new_zeros(n, 0) if loss is None else checks.real_tensor("loss", loss).to(rates)
        if loss.ndim != 2 or len(loss) != n:
            raise checks.fail("loss", f"have shape ({n}, modes)", loss)
        if loss.numel():
            checks.first_bad("loss", "not be negative", loss, loss < 0, "mode")
            total = loss.sum(-1)
            checks.first_bad("loss", "add up to 1", total, (total - 1).abs() > 1e-6, "band")
        damping = (
            rates.new_zeros(()) if contact_damping is None else checks.real_tensor("contact_damping", contact_damping)
        )
        if damping.ndim or bool(damping < 0) or bool(damping > 0) != bool(loss.numel()):
            raise checks.fail("contact_damping", "be a number, above 0 with a loss and 0 without", damping.tolist())
        size = (0,) if guide is None or not guide.numel() else tuple(self.coefficients.shape)
        guide = checks.shaped("guide", rates.new_zeros(0) if guide is None else guide, size)
        self._hold(_rates=rates, guide=guide.to(rates), loss=loss, contact_damping=damping.to(rates))
        self._parts = shapes(self.waves.distances, self.degrees_)  # not part of the file: they follow from the waves

    @property
    def waves(self) -> Waves:
        """Of the effective medium."""
        return Waves(*(self.get_buffer(entry.name) for entry in fields(Waves)))

    @property
    def damped(self) -> bool:
        return bool(self.loss.numel())

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def basis(self) -> Tensor:  # type: ignore[override]
        """Pi [source, receiver], T at infinite time."""
        if self.damped:
            return torch.zeros_like(self._rates)
        return self.at(self._rates.new_full((1,), math.inf))[:, 0]

    @property
    def words(self) -> str:
        return f"degrees {self.degrees_}, {self.n_parameters} fitted numbers"

    @property
    def n_bands(self) -> int:
        return len(self._rates)

    @property
    def n_parameters(self) -> int:
        return len(self.coefficients) + int((self.loss > 0).sum())

    def tensors(self) -> dict[str, Tensor]:
        every = {name: getattr(self, name) for name in self.axes if name != "degrees"}
        if not len(self.guide):
            del every["guide"]
        return {"degrees": self._rates.new_tensor(self.degrees_), **every}

    def _apply(self, fn: Any, recurse: bool = True) -> CompactModel:
        super()._apply(fn, recurse)
        self._parts = fn(self._parts[0]), fn(self._parts[1])
        return self

    def at(self, times: Tensor, sources: Tensor | None = None) -> Tensor:
        """T of undamped chains at times that may be infinite, (source, time, receiver), of all sources or some, by number."""
        sources = torch.arange(self.n_bands, device=times.device) if sources is None else sources
        odds, own = all_odds(self.waves, times, sources)
        place, stays = (part[sources] for part in self._parts)
        moved = odds * factors((place, stays), own, times, self.coefficients, self.degrees_)
        return moved / moved.sum(-1, keepdim=True)

    def _moved(self, times: Tensor, sources: Tensor | None = None) -> Tensor:
        """T, (source, time, receiver), of all sources or some."""
        found = self.at(times, sources)
        if not self.damped:
            return found
        modes = frequencies(self.loss.shape[1])
        left = mode_energy(modes, float(self.contact_damping), times.double().cpu().numpy())
        weights = self.loss if sources is None else self.loss[sources]
        return found * (weights @ torch.from_numpy(left).to(weights).T)[..., None]

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        if initial.requires_grad:
            return torch.einsum("...s,str->...tr", initial, self._moved(times))
        used = (initial.reshape(-1, self.n_bands) != 0).any(0).nonzero()[:, 0]  # other sources have nothing to give
        return torch.einsum("...s,str->...tr", initial[..., used], self._moved(times, used))
