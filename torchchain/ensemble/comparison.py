"""How two results of the same observables differ, in units of their standard errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from torchchain import checks

if TYPE_CHECKING:
    import xarray

BAND_AXES = ("band", "receiver")
ROUNDING = 1e-14
"""Errors up to this share of the largest value are rounding, not chance: such values have no error."""


@dataclass(frozen=True)
class Agreement:
    """Two results of one observable.

    Attributes:
        variable: name of the observable.
        n_values: numbers compared, those at coordinates that both results have.
        largest_difference: largest |a - b|, in the unit of the observable.
        rms_z, largest_z: root mean square and largest |a - b| / sqrt(stderr_a^2 + stderr_b^2); NaN where neither result
            has an error. Two samples of one ensemble have rms_z = 1.
        within_one: share of the numbers with |z| <= 1; 0.683 for two samples of one ensemble.
        total_variation: mean over sources and times of sum |a - b| / 2 over bands; NaN for other observables.
        expected_distance: the total variation expected of two samples of one ensemble with these standard errors.
    """

    variable: str
    n_values: int
    largest_difference: float
    rms_z: float
    largest_z: float
    within_one: float
    total_variation: float
    expected_distance: float

    def __str__(self) -> str:
        words = f"{self.variable}: {self.n_values} values, largest difference {self.largest_difference:.3g}"
        if not math.isnan(self.rms_z):
            within = f"{100 * self.within_one:.0f} % within 1"
            words += f"; z-score rms {self.rms_z:.3g}, largest {self.largest_z:.3g}, {within}"
        if not math.isnan(self.total_variation):
            words += (
                f"; total variation {self.total_variation:.3g}, {self.expected_distance:.3g} expected of two samples"
            )
        return words


def z_scores(a: xarray.Dataset, b: xarray.Dataset, variable: str) -> xarray.DataArray:
    """(a - b) / sqrt(stderr_a^2 + stderr_b^2) where both have coordinates; NaN where neither has an error.

    Args:
        a, b: results with ``variable`` and, where known, ``variable_stderr``.
        variable: name of the observable.

    Raises:
        FieldError: if the results have no coordinate in common.
    """
    difference, error = _difference(a, b, variable)
    return difference / error.where(error > 0)


def compare(a: xarray.Dataset, b: xarray.Dataset) -> list[Agreement]:
    """How every observable that both results hold differs.

    Args:
        a, b: results of :func:`torchchain.simulate` or ``BandTransfer.to_dataset()``.

    Returns:
        One :class:`Agreement` per observable, in the order of ``a``.

    Raises:
        FieldError: if the results have no observable, or no coordinate, in common.
    """
    names = [str(name) for name in a.data_vars if name in b.data_vars and not str(name).endswith("_stderr")]
    names = [name for name in names if not name.startswith("block")]
    if not names:
        raise checks.fail("results", "hold an observable that both have", f"{', '.join(map(str, a.data_vars))}")
    return [_agreement(a, b, name) for name in names]


def _difference(a: xarray.Dataset, b: xarray.Dataset, variable: str) -> tuple[xarray.DataArray, xarray.DataArray]:
    """a - b and its standard error where both have coordinates."""
    import xarray

    if set(a[variable].dims) != set(b[variable].dims):
        raise checks.fail(
            f"{variable} of the second result", f"have the axes {a[variable].dims}", f"{b[variable].dims}"
        )
    first, second = xarray.align(_with_error(a, variable), _with_error(b, variable), join="inner")
    if first["value"].size == 0:
        raise checks.fail(f"{variable} of both results", "have coordinates in common", "none")
    error = (first["error"] ** 2 + second["error"] ** 2) ** 0.5
    scale = max(float(abs(each["value"]).max()) for each in (first, second))
    return first["value"] - second["value"], error.where(~(error <= ROUNDING * scale), 0.0)


def _with_error(data: xarray.Dataset, variable: str) -> xarray.Dataset:
    import xarray

    value = data[variable]
    error = data[f"{variable}_stderr"] if f"{variable}_stderr" in data else xarray.zeros_like(value)
    return xarray.Dataset({"value": value, "error": error})


def _agreement(a: xarray.Dataset, b: xarray.Dataset, variable: str) -> Agreement:
    difference, error = _difference(a, b, variable)
    known = error.values > 0
    z = difference.values[known] / error.values[known]
    axis = next((name for name in BAND_AXES if name in difference.dims), None)
    distance = expected = math.nan
    if axis is not None:
        later = difference.sel(time=difference["time"] > 0) if "time" in difference.dims else difference
        if later.size:
            distance = float(abs(later).sum(axis).mean() / 2)
            # A normal difference of standard deviation s has the mean absolute value s sqrt(2 / pi).
            expected = float(error.sel(later.indexes).sum(axis).mean() / math.sqrt(2 * math.pi))
    rms = top = within = math.nan
    if z.size:
        rms, top, within = float(np.sqrt(np.mean(z**2))), float(np.abs(z).max()), float(np.mean(np.abs(z) <= 1))
    return Agreement(variable, difference.size, float(abs(difference).max()), rms, top, within, distance, expected)
