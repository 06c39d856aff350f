"""The certificate of a model: what is proved of its energies, for its report and its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from torchchain import checks

ROUNDING = 1e-12
"""Shares of the energy that count as zero: rounding of a sum of exponentials in float64."""


@dataclass(frozen=True)
class Certificate:
    """What is proved of T(t) = Pi + sum_m A_m f_m(t), for every t >= 0.

    Attributes:
        lower: no entry of T is below it.
        upper: none is above it.
        conservation_defect: no row sum of T differs from 1 by more, infinity if T decays to zero (damped chains).
        tail: from this time on Pi outweighs all that still decays.
        intervals: of the time axis before it, that were needed.

    Example:
        >>> tc.master.Certificate(lower=0.0, upper=1.0, conservation_defect=1e-16, tail=300.0, intervals=800).holds
        True
    """

    lower: float
    upper: float
    conservation_defect: float
    tail: float
    intervals: int

    @property
    def holds(self) -> bool:
        """Whether T is proved not to be negative, to rounding."""
        return self.lower >= -ROUNDING

    def to_dict(self) -> dict[str, Any]:
        """For the report of a calibration; infinity as a word."""
        return {name: "infinite" if math.isinf(value) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Certificate:
        """The inverse of :meth:`to_dict`, checked."""
        checks.instance("report.certificate", record, dict)
        record = {
            "conservation_defect" if name == "drift" else name: value for name, value in record.items()
        }  # of old files
        names = [entry.name for entry in fields(cls)]
        checks.known_keys("report.certificate", record, names)
        values: dict[str, Any] = {}
        for name in names:
            value = record.get(name, "nothing")
            values[name] = math.inf if value == "infinite" else checks.number(f"report.certificate.{name}", value)
        return cls(
            **values
            | {"intervals": checks.integer("report.certificate.intervals", record.get("intervals", "nothing"), 0)}
        )
