"""What a calibration says of itself, in typed records that its file keeps."""

from __future__ import annotations

import dataclasses
import functools
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchchain import checks
from torchchain.ensemble.scene import Scene
from torchchain.master.proof import ROUNDING, Certificate


@dataclass(frozen=True)
class Rung:
    """One model that the selection tried: name, order where it has one, total variation from the blocks held out.

    Example:
        >>> tc.master.Rung("memory", (2, 3), 0.012).model
        'memory'
    """

    model: str
    order: tuple[int, ...]
    distance: float


@dataclass(frozen=True)
class Selection:
    """How the model was chosen.

    Attributes:
        reason: in words.
        held_out_distance: total variation of the chosen model, fitted to half of the blocks, from the other half.
        halves_distance: total variation of the two halves; both None where nothing was held out.
        tried: from the fewest fitted numbers up.

    Example:
        >>> scene = tc.Scene(n_particles=64, n_bands=8, realizations=40)
        >>> chosen = tc.calibrate(tc.band_transfer(scene, method="modes"), bootstrap=0).calibration.report.selection
        >>> len(chosen.tried) >= 1, chosen.held_out_distance > 0
        (True, True)
    """

    reason: str
    held_out_distance: float | None = None
    halves_distance: float | None = None
    tried: tuple[Rung, ...] = ()


@dataclass(frozen=True)
class Loss:
    """The damping d of Eq. 51 [band], and the root mean square of the lost energy that it leaves unexplained.

    Example:
        >>> scene = tc.Scene(n_particles=32, n_bands=4, realizations=8, damping=0.02, times=torch.linspace(0, 20, 41))
        >>> transfer = tc.band_transfer(scene, method="damped", long_time=False)
        >>> len(tc.calibrate(transfer, model="paper", method="linear").calibration.report.loss.rates)
        4
    """

    rates: tuple[float, ...]
    misfit: float

    def __post_init__(self) -> None:
        if any(not rate >= 0 for rate in self.rates):
            raise checks.fail("loss.rates", "not be negative", list(self.rates))


@dataclass(frozen=True)
class Report:
    """How a calibration went.

    Attributes:
        fit: the record of the method, ``Fit.report``; None where there is nothing to tell.
        selection: None where method and model were named.
        loss: of damped chains.
        horizon: last time at which predictions were compared with chains; infinite where these had settled.
        bootstrap: ensembles drawn again for the error bars.
        certificate: proof that no energy is ever negative; None where there is none.
        ordered: without disorder nothing moves, and nothing was fitted.
        coarsened_from: number of bands of the model that this one was made of.
        interpolated: strengths of a family and their weights, of which this one is the sum.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=40), method="modes")
        >>> report = tc.calibrate(transfer, model="exact_psi", method="linear").calibration.report
        >>> report.selection is None, report.bootstrap
        (True, 20)
    """

    fit: Any = None
    selection: Selection | None = None
    loss: Loss | None = None
    horizon: float = math.inf
    bootstrap: int = 0
    ordered: bool = False
    coarsened_from: int | None = None
    interpolated: tuple[tuple[float, float], ...] = ()
    certificate: Certificate | None = None

    def __post_init__(self) -> None:
        if self.certificate is not None and not self.certificate.holds:
            raise checks.fail("report.certificate.lower", f"be at least {-ROUNDING:g}", self.certificate.lower)

    def to_dict(self) -> dict[str, Any]:
        """Numbers, words, lists and tables; an infinite horizon is left out."""
        plain = dataclasses.asdict(self)
        if self.horizon == math.inf:
            del plain["horizon"]
        if self.certificate is None:
            del plain["certificate"]
        else:
            plain["certificate"] = self.certificate.to_dict()
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any], fit: type | None) -> Report:
        """The inverse of :meth:`to_dict`, checked; ``fit`` is the record of the method."""
        rest = {name: value for name, value in plain.items() if name not in ("fit", "certificate")}
        told = plain.get("fit")
        if told is not None and fit is None:
            raise checks.fail("report.fit", "be of a registered method", told)
        found = None if told is None or fit is None else read("report.fit", fit, told)
        proof = plain.get("certificate")
        proved = None if proof is None else Certificate.from_dict(proof)
        report = dataclasses.replace(read("report", cls, rest), fit=found, certificate=proved)
        if not report.horizon >= 0:
            raise checks.fail("report.horizon", "be at least 0", report.horizon)
        return report


@dataclass(frozen=True)
class Calibration:
    """How a master equation came to be.

    Attributes:
        method, model: names of the fit and of the reduced model.
        window: first and last time of a fit at short times.
        scene: of the chains; None for energies from elsewhere.
        report: see :class:`Report`.
        provenance: where energies without a scene come from.

    Example:
        >>> transfer = tc.band_transfer(tc.Scene(n_particles=64, n_bands=8, realizations=20), method="modes")
        >>> found = tc.calibrate(transfer, model="paper", method="linear").calibration
        >>> found.method, found.model, found.window, found.strength
        ('linear', 'paper', (0.5, 2.0), 0.3)
    """

    method: str
    model: str
    window: tuple[float, float] | None
    scene: Scene | None = None
    report: Report = dataclasses.field(default_factory=Report)
    provenance: str = ""

    @property
    def strength(self) -> float | None:
        """Disorder xi of the chains, None if unknown."""
        return None if self.scene is None else self.scene.disorder.strength


def read(name: str, kind: Any, value: Any) -> Any:
    """A value from JSON as the type that a record declares; an error names the field.

    Numbers, words, truth values, tuples, records, and None where it is allowed.
    """
    if kind is Any:
        return value
    origin, inside = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        (wanted,) = (part for part in inside if part is not type(None))
        return None if value is None else read(name, wanted, value)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise checks.FieldTypeError(f"{name} must be a list, got {checks.shown(value)}")
        parts = inside[:1] * len(value) if inside[-1] is Ellipsis else inside
        if len(parts) != len(value):
            raise checks.fail(name, f"hold {len(parts)} values", value)
        return tuple(read(name, part, item) for part, item in zip(parts, value, strict=True))
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise checks.FieldTypeError(f"{name} must be a table, got {checks.shown(value)}")
        hints = _hints(kind)  # type: ignore[arg-type]
        fields = {entry.name: entry for entry in dataclasses.fields(kind)}
        checks.known_keys(name, value, fields)
        for key, entry in fields.items():
            needed = entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
            if needed and key not in value:
                raise checks.fail(name, f"have the key {key}", "none")
        return kind(**{key: read(f"{name}.{key}", hints[key], item) for key, item in value.items()})  # type: ignore[operator]
    if kind is bool:
        return checks.truth(name, value)
    if kind is int:
        return checks.integer(name, value)
    if kind is float:
        return checks.number(name, value)
    if not isinstance(value, kind):
        raise checks.FieldTypeError(f"{name} must be of type {kind.__name__}, got {checks.shown(value)}")
    return value


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    """The declared types of a record; Python evaluates them, so this is done once and never of what a file says."""
    return typing.get_type_hints(kind)
