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
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.master.certificate import CertificateError
from torchchain.master.loss import frequencies, mode_energy
from torchchain.master.memory import ORDERS, MemoryModel, checked_order, fit_memory
from torchchain.master.model import Embedding, TransferModel
from torchchain.master.nonnegative import nonnegative
from torchchain.master.proof import Certificate
from torchchain.master.waves import Waves, first_odds

CLOCK = 10.0
"""t0 of the clock tau."""

LOWEST_SHARE = -1e-6
"""Least energy, of the whole, of a model with memory that stands for another where no certified one is found."""

LARGEST_EXPONENT = 60.0  # natural logarithm of a factor of the odds


def checked_degrees(degrees: Any) -> tuple[int, int, int]:
    """Degrees of the polynomials in place, distance and time."""
    if not isinstance(degrees, (tuple, list)) or len(degrees) != 3:
        raise checks.FieldTypeError(f"degrees must be three integers, got {checks.shown(degrees)}")
    place, distance, time = (checks.integer("degrees", degree, 1, 40) for degree in degrees)
    return place, distance, time


def _highest(share: float, degree: int) -> int:
    return math.floor(degree * (1 - share) + 1e-9)


def terms(degrees: Sequence[int]) -> tuple[list[tuple[int, int, int]], list[tuple[int, int]]]:
    """The products of polynomials in p, by their degrees in (u, v, tau), and in q, by those in (s, tau).

    Those with i / I + j / J + k / K <= 1: a simplex, since what is fine in place is coarse in time.
    """
    place, distance, time = degrees
    p = [
        (i, j, k)
        for i in range(place + 1)
        for j in range(distance + 1)
        if i / place + j / distance <= 1 + 1e-9
        for k in range(_highest(i / place + j / distance, time) + 1)
    ]
    return p, [(i, k) for i in range(place + 1) for k in range(_highest(i / place, time) + 1)]


def n_coefficients(degrees: Sequence[int]) -> int:
    """Fitted numbers of a model of these degrees; they do not depend on the number of bands."""
    p, q = terms(checked_degrees(degrees))
    return len(p) + len(q)


def carried(coefficients: np.ndarray, degrees: Sequence[int], others: Sequence[int]) -> np.ndarray:
    """Coefficients of the same polynomials for other degrees: those of products that are new are 0."""
    p, q = terms(degrees)
    known = dict(zip([*p, *q], coefficients.tolist(), strict=True))
    p, q = terms(others)
    return np.array([known.get(entry, 0.0) for entry in [*p, *q]])


class CompactModel(TransferModel):
    """T[s, r](t) = o_sr / (own_s + sum o_sr'): odds of a damped beat times the exponential of polynomials (see the module).

    For every t >= 0 and any coefficients no entry is negative, every row adds up to 1, T(0) = I, and T(t) - I starts as t^4:
    odds are a positive D times an exponential of a bounded exponent (+-LARGEST_EXPONENT), the own band's are an
    exponential alone, so that the sum which a row is divided by is positive; and D(0) = 0. Of damped chains these are
    shares of what is left of the energy, which :mod:`torchchain.master.loss` describes.

    Args:
        rates: Q [source, receiver] of the linear procedure at short times, for comparison.
        degrees: of the polynomials in place, distance and time, (3,).
        coefficients: of :func:`terms`, p first, (term,).
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
    rates_meaning: ClassVar[str] = MemoryModel.rates_meaning
    has_equation: ClassVar[bool] = False

    def __init__(
        self, rates: Tensor, degrees: Tensor, coefficients: Tensor, source_frequency: Tensor, source_decay: Tensor,
        tone_frequency: Tensor, tone_decay: Tensor, coupling: Tensor, loss: Tensor | None = None,
        contact_damping: Tensor | None = None, guide: Tensor | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        rates = checks.real_tensor("rates", rates)
        if rates.ndim != 2 or rates.shape[0] != rates.shape[1] or not rates.numel():
            raise checks.fail("rates", "be a square matrix", f"shape {tuple(rates.shape)}")
        degrees = checks.real_tensor("degrees", degrees)
        self.degrees_ = checked_degrees([int(value) for value in degrees.flatten()])
        self.register_buffer("_rates", rates.detach().clone())
        self._rates: Tensor
        found = {
            "source_frequency": (source_frequency, (len(rates),)), "source_decay": (source_decay, (len(rates),)),
            "tone_frequency": (tone_frequency, (len(rates), *tone_frequency.shape[1:2])),
            "tone_decay": (tone_decay, (len(rates), *tone_frequency.shape[1:2])), "coupling": (coupling, ()),
            "coefficients": (coefficients, (n_coefficients(self.degrees_),)),
        }  # fmt: skip
        for name, (value, shape) in found.items():
            value = checks.real_tensor(name, value).to(rates)
            if tuple(value.shape) != shape or 0 in shape:
                raise checks.fail(name, f"have shape {shape}", f"shape {tuple(value.shape)}")
            if name != "coefficients":
                checks.first_bad(name, "be positive", value, ~(value > 0), "band")
            self.register_buffer(name, value.detach().clone())
        loss = rates.new_zeros(len(rates), 0) if loss is None else checks.real_tensor("loss", loss).to(rates)
        if loss.ndim != 2 or len(loss) != len(rates):
            raise checks.fail("loss", f"have shape ({len(rates)}, modes)", f"shape {tuple(loss.shape)}")
        if loss.numel():
            checks.first_bad("loss", "not be negative", loss, loss < 0, "mode")
            total = loss.sum(-1)
            checks.first_bad("loss", "add up to 1", total, (total - 1).abs() > 1e-6, "band")
        contact_damping = checks.real_tensor(
            "contact_damping", rates.new_zeros(()) if contact_damping is None else contact_damping
        ).to(rates)
        if contact_damping.ndim or bool(contact_damping < 0) or bool(contact_damping > 0) != bool(loss.numel()):
            raise checks.fail(
                "contact_damping", "be a number, above 0 with a loss and 0 without", contact_damping.tolist()
            )
        guide = checks.real_tensor("guide", rates.new_zeros(0) if guide is None else guide).to(rates)
        if tuple(guide.shape) not in ((0,), tuple(self.coefficients.shape)):
            raise checks.fail("guide", f"have shape {tuple(self.coefficients.shape)}", f"shape {tuple(guide.shape)}")
        self.register_buffer("guide", guide.detach().clone())
        self.register_buffer("loss", loss.detach().clone())
        self.register_buffer("contact_damping", contact_damping.detach().clone())
        self.loss: Tensor
        self.contact_damping: Tensor
        self.source_frequency: Tensor
        self.source_decay: Tensor
        self.tone_frequency: Tensor
        self.tone_decay: Tensor
        self.coupling: Tensor
        self.coefficients: Tensor
        self.guide: Tensor
        place, own = shapes(self.waves, self.degrees_)
        self._place, self._own = place, own  # not part of the file: they follow from the waves

    @property
    def waves(self) -> Waves:
        """Of the effective medium."""
        return Waves(self.source_frequency, self.source_decay, self.tone_frequency, self.tone_decay, self.coupling)

    @property
    def rates(self) -> Tensor:
        return self._rates

    @property
    def basis(self) -> Tensor:  # type: ignore[override]
        """Pi [source, receiver], T at infinite time."""
        if self.loss.numel():
            return torch.zeros_like(self._rates)
        return self.at(self._rates.new_full((1,), math.inf))[:, 0]

    @property
    def damping(self) -> Tensor:  # type: ignore[override]
        """None on top of the model's own, [band]."""
        return torch.zeros_like(self._rates[0])

    @property
    def words(self) -> str:
        return f"degrees {self.degrees_}, {self.n_parameters} fitted numbers"

    @property
    def n_bands(self) -> int:
        return len(self._rates)

    @property
    def n_parameters(self) -> int:
        return len(self.coefficients) + int((self.loss > 0).sum())

    @property
    def conservation_defect(self) -> float:
        """Rows are divided by their sum."""
        return 0.0

    @property
    def certificate(self) -> Certificate:
        """By construction, for every t >= 0."""
        slack = 2 * self.n_bands * torch.finfo(self._rates.dtype).eps
        return Certificate(0.0, 1.0 + slack, math.inf if self.loss.numel() else slack, 0.0, 0)

    def tensors(self) -> dict[str, Tensor]:
        degrees = self._rates.new_tensor(self.degrees_)
        return {
            "rates": self.rates,
            "degrees": degrees,
            "coefficients": self.coefficients,
            "loss": self.loss,
            "contact_damping": self.contact_damping,
            **self.waves.tensors(),
            **({"guide": self.guide} if len(self.guide) else {}),
        }

    def _apply(self, fn: Any, recurse: bool = True) -> CompactModel:
        super()._apply(fn, recurse)
        self._place, self._own = fn(self._place), fn(self._own)
        return self

    def at(self, times: Tensor, sources: Tensor | None = None) -> Tensor:
        """T of undamped chains at times that may be infinite, (source, time, receiver), of all sources or some, by number."""
        sources = torch.arange(self.n_bands, device=times.device) if sources is None else sources
        odds = first_odds(self.waves, times, sources)
        clock = polynomials(clock_of(times), self.degrees_[2])
        p, q = terms(self.degrees_)
        moved = odds * power(self._place[sources], clock, self.coefficients[: len(p)], p)
        own = power(self._own[sources], clock, self.coefficients[len(p) :], q)[:, :, 0]
        mask = torch.nn.functional.one_hot(sources, self.n_bands).to(moved)[:, None]
        moved = moved * (1 - mask) + own[:, :, None] * mask
        return moved / moved.sum(-1, keepdim=True)

    def _moved(self, times: Tensor, sources: Tensor | None = None) -> Tensor:
        """T, (source, time, receiver), of all sources or some."""
        found = self.at(times, sources)
        if not self.loss.numel():
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

    def as_memory(self, order: tuple[int, int] = (4, 6), span: float = 1e3) -> MemoryModel:
        """The nearest model with memory, certified if undamped: exponentials for whoever needs a linear differential equation.

        Where no order has one that is never negative, the least negative, if its energies are above -1e-6 of the whole.

        Args:
            order: numbers of exponentials and of pairs, or the next smaller ones with which a model is never negative.
            span: last time at which the two are compared.

        Raises:
            CertificateError: if there is none of any order.
        """
        return nearest_memory(self, order, span, bool(self.loss.numel()))

    def embedding(self) -> Embedding:
        """That of the nearest model with memory (:meth:`as_memory`): these odds obey no linear equation of their own."""
        return self.as_memory().embedding()


def nearest_memory(model: TransferModel, order: tuple[int, int], span: float, damped: bool) -> MemoryModel:
    """The model with memory that is nearest to one without a linear equation: see ``CompactModel.as_memory``."""
    times = torch.cat([
        torch.linspace(0.25, 5, 20, dtype=torch.float64), torch.logspace(math.log10(5.3), math.log10(span), 90, dtype=torch.float64),
    ])  # fmt: skip
    own = model if model.basis.dtype == torch.float64 else copy.deepcopy(model).double()
    with torch.no_grad():
        mean, basis = own.transfer(times), own.basis
    order = checked_order(order, len(times))
    near: list[tuple[float, MemoryModel]] = []
    for smaller in (order, *(known for known in ORDERS[::-1] if sum(known) < sum(order))):
        found = MemoryModel(rates=own.rates, **fit_memory(times, mean, basis, smaller)[0])
        if damped:  # what decays to nothing has no long-time energy to stay above of
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


def clock_of(times: Tensor) -> Tensor:
    """tau, 0 at the start and 1 at infinity."""
    root = times.sqrt()
    return torch.where(times.isinf(), torch.ones_like(root), root / (root + math.sqrt(CLOCK)))


def polynomials(x: Tensor, degree: int) -> Tensor:
    """Legendre polynomials on [0, 1] of degree 0 to ``degree``, on a last axis of their own."""
    y = 2 * x - 1
    found = [torch.ones_like(y), y]
    for n in range(1, degree):
        found.append(((2 * n + 1) * y * found[-1] - n * found[-2]) / (n + 1))
    return torch.stack(found[: degree + 1], dim=-1)


def shapes(waves: Waves, degrees: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """Polynomials of place and distance for each pair, [source, receiver, term], and of place, [source, 1, term]."""
    n = len(waves.source_frequency)
    band = torch.arange(n, dtype=waves.source_frequency.dtype, device=waves.source_frequency.device) / max(n - 1, 1)
    off = ~torch.eye(n, dtype=torch.bool, device=band.device)
    far = (waves.tone_frequency.mean(1) - waves.source_frequency[:, None]).abs()
    far = torch.asinh(far / (waves.source_decay[:, None] + waves.tone_decay.mean(1)))
    low, high = (far[off].min(), far[off].max()) if n > 1 else (far.min(), far.max())
    far = ((far - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
    place = polynomials((band[:, None] + band) / 2, degrees[0])
    distance = polynomials(far, degrees[1])
    p, _ = terms(degrees)
    pairs = list(dict.fromkeys((i, j) for i, j, _ in p))
    first = torch.stack([place[..., i] * distance[..., j] for i, j in pairs], dim=-1)
    own = polynomials(band, degrees[0])
    return first, own[:, None]


def power(shape: Tensor, clock: Tensor, coefficients: Tensor, index: list[Any]) -> Tensor:
    """exp of the polynomials, [source, time, receiver], from shapes [source, receiver, term] and clock [time, degree]."""
    heads = list(dict.fromkeys(entry[:-1] for entry in index))
    place = {head: i for i, head in enumerate(heads)}
    table = coefficients.new_zeros(len(heads), clock.shape[-1])
    rows = torch.tensor([place[entry[:-1]] for entry in index], device=table.device)
    columns = torch.tensor([entry[-1] for entry in index], device=table.device)
    table = table.index_put((rows, columns), coefficients)
    exponent = torch.einsum("srp,pt->str", shape, table @ clock.T)
    return exponent.clamp(-LARGEST_EXPONENT, LARGEST_EXPONENT).exp()
