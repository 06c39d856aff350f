"""Models that the theory of disorder derives: without a fitted number, and with a few that mend what it misses.

The transfer T0 of :mod:`torchchain.theory` is computed from the law of the masses wherever the model is asked. Where it is
to be mended, its entries are odds, as in :mod:`torchchain.master.compact`, which polynomials of place, distance and time
multiply:

    T[s, r](t) = o_sr / sum_r' o_sr',   o_sr = T0[s, r](t) exp(p(u, v, tau)),   o_ss = T0[s, s](t) exp(q(u, tau)).

For masses of few values they may be multiplied by what clusters of light ones ring, too (:mod:`torchchain.master.ringing`).
For any coefficients nothing is negative, rows add up to 1, T(0) = I, and without coefficients T = T0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.transfer import BandTransfer
from torchchain.master.compact import OddsModel
from torchchain.master.compact_record import WINDOWS, CompactReport, CompactSettings, drawn_again, rungs_of
from torchchain.master.fits import linear_weights
from torchchain.master.logistic import BEYOND, Regression, fit_points, solve, stepped
from torchchain.master.model import TransferModel
from torchchain.master.polynomials import checked_degrees, factors, n_coefficients, shapes
from torchchain.master.records import Fit, Fitted, Progress, Recipe, ReducedModel
from torchchain.master.ringing import Degrees, Ringing, RingingRegression, checked_ringing, size_of, smooth_of
from torchchain.master.sample import Sample
from torchchain.master.theory_rings import Ring, derived
from torchchain.master.uncertainty import later_times
from torchchain.theory.ladder import Waves
from torchchain.theory.law import Law
from torchchain.theory.mean_wave import MOST_VALUES
from torchchain.theory.transfer import described
from torchchain.threads import single_blas_thread

LADDER = ((1, 1, 2), (2, 2, 4), (3, 3, 6), (4, 4, 8))
"""Degrees in place, distance and time that are tried one after the other."""
RINGING_LADDER = ((8, 4, 16, 4, 8), (8, 4, 16, 5, 12))
"""The same of corrections that ring, with the ringing's degree and its frequencies: 486 and 750 numbers."""
NEAREST = 1.0
"""Distance from fresh chains over that of two ensembles, up to which it will do: as near as another ensemble would be."""
SHORTEST, FEWEST_BANDS = 64, 8
"""Particles and bands from which on selection tries the theory."""
MOST_RINGING_BANDS = 64
"""Bands up to which selection tries the ringing, whose fit costs as their square: half a minute of processor time at 64."""
RATE_TIMES = (0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)  # of the slopes that stand for rates


class TheoryModel(OddsModel):
    """The transfer of the theory, times exponentials of polynomials where it has coefficients (see the module).

    Args:
        law_values, law_weights: of the masses, (node,); of the compliances for ``dual``.
        n_particles: N.
        tones: the sources, one in each band, (band,).
        dual: 1 for random stiffnesses of equal masses, else 0.
        contact_damping: of the contacts.
        degrees: of the polynomials in place, distance and time, (3,); (0,) for none; of one that rings also of the ringing's
            polynomials and of how many frequencies, (5,).
        coefficients: of :func:`torchchain.master.polynomials.terms`, then of the ringing by beat and product, (term,).

    Example:
        >>> model = tc.master.TheoryModel.of(tc.Scene(n_particles=64, n_bands=8, disorder=tc.Disorder(strength=0.2)))
        >>> model.n_parameters, model.transfer(torch.tensor([0.0, 10.0], dtype=torch.float64)).shape
        (0, torch.Size([8, 2, 8]))
    """

    kind: ClassVar[str] = "theory"
    axes: ClassVar[dict[str, tuple[str, ...]]] = {
        "law_values": ("node",), "law_weights": ("node",), "n_particles": (), "tones": ("band",), "dual": (),
        "contact_damping": (), "degrees": ("degree",), "coefficients": ("term",),
    }  # fmt: skip

    def __init__(
        self, law_values: Tensor, law_weights: Tensor, n_particles: Tensor, tones: Tensor, dual: Tensor,
        contact_damping: Tensor, degrees: Tensor, coefficients: Tensor,
    ) -> None:  # fmt: skip
        super().__init__()
        values, weights = (
            checks.real_tensor(n, v) for n, v in (("law_values", law_values), ("law_weights", law_weights))
        )
        if values.ndim != 1 or values.shape != weights.shape or not len(values):
            raise checks.fail("law_weights", f"have shape {tuple(values.shape)}", weights)
        checks.first_bad("law_values", "be positive", values, ~(values > 0), "node")
        checks.first_bad("law_weights", "be positive", weights, ~(weights > 0), "node")
        if abs(float(weights.sum()) - 1) > 1e-4:
            raise checks.fail("law_weights", "add up to 1", float(weights.sum()))
        n = _whole("n_particles", n_particles, 4)
        bands = len(checks.real_tensor("tones", tones))
        numbers = tuple(_whole("tones", tone, 1, n // 2) for tone in tones)
        if not bands or n % (2 * bands) or [(tone - 1) // (n // 2 // bands) for tone in numbers] != list(range(bands)):
            raise checks.fail("tones", "lie one in each band, in order", numbers)
        loss = checks.number("contact_damping", float(contact_damping), at_least=0)
        check = checked_ringing if len(degrees) == 5 else checked_degrees
        self.degrees_ = None if len(degrees) == 1 else check([int(degree) for degree in degrees])
        size = 0 if self.degrees_ is None else size_of(self.degrees_)
        self._hold(coefficients=checks.shaped("coefficients", coefficients, (size,)))
        self.ring = Ring(
            tuple(values.double().tolist()), tuple(weights.double().tolist()), n, bands, numbers,
            bool(float(dual)), loss,
        )  # fmt: skip

    @classmethod
    def of(cls, scene: Scene, degrees: Degrees | None = None, coefficients: Tensor | None = None) -> TheoryModel:
        """The model of a scene's chains."""
        check_scene(scene)
        law, _ = covered(scene)
        soft = scene.stiffness_disorder is not None and scene.stiffness_disorder.strength > 0
        numbers = {"n_particles": scene.n_particles, "dual": soft, "contact_damping": scene.damping}
        scalars = {name: torch.tensor(float(value), dtype=torch.float64) for name, value in numbers.items()}
        return cls(
            law_values=law.values, law_weights=law.weights, tones=torch.tensor(scene.tones, dtype=torch.float64),
            degrees=torch.tensor(degrees or (0,), dtype=torch.float64),
            coefficients=torch.zeros(0, dtype=torch.float64) if coefficients is None else coefficients, **scalars,
        )  # fmt: skip

    def tensors(self) -> dict[str, Tensor]:
        new, ring = self.coefficients.new_tensor, self.ring
        return {
            "law_values": new(ring.values), "law_weights": new(ring.weights), "n_particles": new(float(ring.n_particles)),
            "tones": new([float(tone) for tone in ring.tones]), "dual": new(float(ring.dual)),
            "contact_damping": new(ring.damping), "degrees": new([float(d) for d in self.degrees_ or (0,)]),
            "coefficients": self.coefficients,
        }  # fmt: skip

    @property
    def n_bands(self) -> int:
        return self.ring.n_bands

    @property
    def n_parameters(self) -> int:
        return len(self.coefficients)

    @property
    def words(self) -> str:
        if self.degrees_ is None:
            return "from the law of the disorder, no fitted number"
        return f"the theory's, degrees {self.degrees_}, {self.n_parameters} fitted numbers"

    @property
    def damped(self) -> bool:
        return self.ring.damping > 0

    @property
    def basis(self) -> Tensor:  # type: ignore[override]
        """Pi [source, receiver], T at infinite time."""
        return self._at(self.coefficients.new_full((1,), math.inf))[:, 0]

    @property
    def rates(self) -> Tensor:
        """Slopes at short times, by procedure L from t = 0.5 to 2, [source, receiver]."""
        times = self.coefficients.new_tensor(RATE_TIMES)
        return torch.einsum("t,str->sr", linear_weights(times, (RATE_TIMES[0], RATE_TIMES[-1])), self._at(times))

    def _at(self, times: Tensor) -> Tensor:
        found = derived(self.ring, times).to(self.coefficients)
        if self.degrees_ is None:
            return found
        moved = found * self._factor(times, found)
        return moved * (found.sum(-1, keepdim=True) / moved.sum(-1, keepdim=True))

    def _factor(self, times: Tensor, like: Tensor) -> Tensor:
        """Of each pair's odds, positive, [source, time, receiver]."""
        assert self.degrees_ is not None, "there are coefficients"
        degrees = smooth_of(self.degrees_)
        first, own = (part.to(like) for part in shapes(self.ring.distances, degrees))
        count = n_coefficients(degrees)
        smooth, rings = self.coefficients[:count], self.coefficients[count:]
        factor = factors((first, own), torch.eye(self.n_bands).to(like)[:, None], times, smooth, degrees)
        if len(rings):
            factor = factor * Ringing.of(self.ring, *self.degrees_[3:]).exponent(times, rings).exp()
        return factor

    def propagate(self, initial: Tensor, times: Tensor) -> Tensor:
        return torch.einsum("...s,str->...tr", initial, self._at(times))


def _whole(name: str, value: Tensor, least: int, most: int | None = None) -> int:
    number = float(value)
    return checks.integer(name, int(number) if number.is_integer() else number, least, most)


def compared(scene: Scene | None) -> bool:
    """Whether the theory was compared with chains as long and bands as many: shorter rings have levels too few for its sums."""
    return scene is not None and scene.n_particles >= SHORTEST and scene.n_bands >= FEWEST_BANDS


def check_scene(scene: Scene | None) -> Scene:
    """The scene; raise for chains that the theory does not hold for."""
    if scene is None:
        raise checks.fail("transfer", "be of chains of a scene for model 'theory'", "energies without one")
    covered(scene)
    if len(scene.tones) != scene.n_bands:
        raise checks.fail("n_bands", "have one tone each for model 'theory'", scene.n_bands)
    return scene


def covered(scene: Scene) -> tuple[Law, Waves]:
    """The law and the waves of a scene; an error for chains that the theory does not hold for."""
    wanted: dict[str, Any] = {"lattice": None, "species": (), "energy_definition": "site"}
    for name, value in wanted.items():
        if getattr(scene, name) != value:
            raise checks.fail(name, f"be {value} for model 'theory'", getattr(scene, name))
    return described(
        scene.disorder, scene.n_particles, scene.n_bands, scene.tones, scene.boundary, scene.stiffness_disorder,
        scene.contact, scene.damping,
    )  # fmt: skip


def check_corrected(scene: Scene | None) -> Scene:
    """The scene; raise for chains that the corrected theory is not made for."""
    scene = check_scene(scene)
    if scene.damping:
        raise checks.fail("damping", "be 0 for model 'corrected_theory'", scene.damping)
    if scene.n_bands < 2:
        raise checks.fail("n_bands", "be at least 2 for model 'corrected_theory'", scene.n_bands)
    return scene


def ringing_compared(scene: Scene | None) -> bool:
    """The same of the ringing, as long as its fit is quick."""
    return scene is not None and compared(scene) and scene.n_bands <= MOST_RINGING_BANDS


def check_ringing(scene: Scene | None) -> Scene:
    """The scene; raise for chains in which no clusters ring alike: those of masses, or compliances, of many values."""
    scene = check_corrected(scene)
    law, _ = covered(scene)
    if not 1 < len(law.values) <= MOST_VALUES:
        raise checks.fail("disorder.kind", "be 'binary' for model 'ringing_theory'", repr(scene.disorder.kind))
    return scene


@dataclass(frozen=True)
class RingingSettings(CompactSettings):
    """Settings of the regression with beats: degrees also of the ringing in both places, and its frequencies."""

    def _checked(self) -> Degrees:
        return checked_ringing(self.degrees)


def _derive(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
    return _derived_for(check_scene(sample.scene), sample.times, sample.damped), None


def _derived_for(scene: Scene, times: Tensor, damped: bool) -> TheoryModel:
    """The model of a scene, with all that a calibration asks of it at hand."""
    model, end = TheoryModel.of(scene), times[-1:]
    if end > 0 and not damped:
        derived(model.ring, torch.cat([times, end * end.new_tensor(BEYOND), later_times(float(end))]))
    return model


def foresee(scene: Scene) -> None:
    """Compute what the selection of a model for a scene will ask of the theory, where it will: before there are any chains."""
    if THEORY.describes(scene) and THEORY.tried_on(scene) and scene.distinct_realizations // scene.sample_size >= 4:
        _derived_for(scene, scene.times, scene.largest_damping > 0)


def _regression(sample: Sample, degrees: Degrees) -> tuple[Regression, TheoryModel]:
    start = TheoryModel.of(sample.chains, degrees, torch.zeros(size_of(degrees), dtype=torch.float64))
    times, data, weight = fit_points(sample.times, sample.mean, sample.long_time, sample.distance)
    smooth = smooth_of(degrees)
    given = derived(start.ring, times), shapes(start.ring.distances, smooth), smooth, times, data, weight
    if len(degrees) == 3:
        return Regression.of_odds(*given), start
    return RingingRegression.of_odds(*given, ringing=Ringing.of(start.ring, *degrees[3:]), when=times), start


def _correct(sample: Sample, recipe: Recipe, near: TransferModel | None, progress: Progress) -> Fitted:
    degrees = recipe.settings.degrees
    (check_ringing if len(degrees) == 5 else check_corrected)(sample.scene)
    problem, model = _regression(sample, degrees)
    first = near.coefficients if isinstance(near, TheoryModel) and near.degrees_ == degrees else model.coefficients
    with single_blas_thread():
        found, told = solve([problem], np.ones((1, 1)), first.double().cpu().numpy()[None], progress)
    tensors = model.tensors() | {"coefficients": torch.from_numpy(found[0])}
    return TheoryModel(**tensors), CompactReport(**told, degrees=degrees)


def _same(transfer: BandTransfer, recipe: Recipe, model: TheoryModel, repeats: Tensor) -> Iterator[TheoryModel]:
    """No ensemble comes into it."""
    return iter([model] * len(repeats))


def _again(transfer: BandTransfer, recipe: Recipe, model: TheoryModel, repeats: Tensor) -> Iterator[TheoryModel]:
    problem, _ = _regression(Sample.of(transfer), model.degrees_ or LADDER[0])
    found = model.coefficients.detach().double().cpu().numpy()[None]
    with single_blas_thread():
        others = stepped([problem], np.ones((1, 1)), found, [drawn_again(transfer, repeats).numpy()])[:, 0]
    for other in others:
        yield TheoryModel(**model.tensors() | {"coefficients": torch.from_numpy(other)})


THEORY = ReducedModel(
    "theory", "the theory of disorder: no fitted number, and no ensemble", TheoryModel,
    (Fit("derivation", "from the law of the masses", _derive),), lambda n_bands, damped, settings: 0,
    climbed_by="derivation", needs_strength=True, fits_loss=True, check_scene=check_scene, tried_on=compared, windows=WINDOWS,
    near=NEAREST, never_negative=True, slow=True, replicas=_same,
)  # fmt: skip
CORRECTED = ReducedModel(
    "corrected_theory", "the theory times exponentials of polynomials: some tens of numbers, never negative", TheoryModel,
    (Fit("correction", "logistic regression on all times", _correct, settings=CompactSettings, report=CompactReport),),
    lambda n_bands, damped, settings: size_of(settings.degrees or LADDER[0]), climbed_by="correction",
    needs_long_time=True, needs_strength=True, rungs=rungs_of(CompactSettings, LADDER), check_scene=check_corrected, tried_on=compared, windows=WINDOWS,
    near=NEAREST, never_negative=True, slow=True, replicas=_again,
)  # fmt: skip
RINGING = ReducedModel(
    "ringing_theory", "the corrected theory with the beats of clusters of light particles: for binary masses, never negative", TheoryModel,
    (Fit("ringing", "regression on all times, with beats", _correct, settings=RingingSettings, report=CompactReport),),
    lambda n_bands, damped, settings: size_of(settings.degrees or RINGING_LADDER[0]), climbed_by="ringing",
    needs_long_time=True, needs_strength=True, rungs=rungs_of(RingingSettings, RINGING_LADDER), check_scene=check_ringing, tried_on=ringing_compared, windows=WINDOWS,
    never_negative=True, slow=True, replicas=_again,
)  # fmt: skip
