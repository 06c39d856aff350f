"""One validator per concept; every error names the field, the rule and the value."""

from __future__ import annotations

import dataclasses
import math
import numbers
import re
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from torchchain.spelling import suggestion


class FieldError(ValueError):
    """A value that breaks a rule: the message reads ``field must rule, got value``.

    Example:
        >>> try:
        ...     tc.Disorder(strength=-0.1)
        ... except tc.FieldError as error:
        ...     print(error)
        disorder.strength must be at least 0, got -0.1
    """


class FieldTypeError(TypeError):
    """A value of the wrong type, worded like :class:`FieldError`.

    Example:
        >>> try:
        ...     tc.Disorder(strength="weak")
        ... except tc.FieldTypeError as error:
        ...     print(error)
        disorder.strength must be a number, got 'weak'
    """


class Fields:
    """A dataclass whose misspelled fields are errors that name the ones most likely meant."""

    if not TYPE_CHECKING:  # type checkers know the fields

        def __new__(cls, *_: Any, **given: Any) -> Any:
            """See the class."""
            names = [each.name for each in dataclasses.fields(cls) if each.init]
            for name in given:
                if name not in names:
                    kind = re.sub("(?<=[a-z])(?=[A-Z])", " ", cls.__name__).lower()
                    raise FieldTypeError(f"{with_article(kind)} has no field {name!r}{suggestion(name, names)}")
            return super().__new__(cls)


def with_article(noun: str) -> str:
    """``a Scene``, ``an Impulse``."""
    return f"{'an' if noun[0].lower() in 'aeiou' else 'a'} {noun}"


def shown(value: Any, width: int = 80) -> str:
    """The value as one short line, for an error message."""
    text = " ".join(repr(value).split())
    return text if len(text) <= width else text[: width - 3] + "..."


def fail(field: str, rule: str, value: Any) -> FieldError:
    """The error for a ``field`` whose ``value``, of a tensor its shape, breaks the ``rule``, to be raised by the caller."""
    if isinstance(value, Tensor):
        value = f"shape {tuple(value.shape)}"
    words = value if isinstance(value, str) else shown(value)
    return FieldError(" ".join(f"{field} must {rule}, got {words}".split()))  # one line, whatever is in a path


def integer(field: str, value: Any, minimum: int | None = None, maximum: int | None = None) -> int:
    """The value as an int within [minimum, maximum]; a bool or a fraction is an error."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise FieldTypeError(f"{field} must be an integer, got {shown(value)}")
    value = int(value)
    if minimum is not None and value < minimum:
        raise fail(field, f"be at least {minimum}", value)
    if maximum is not None and value > maximum:
        raise fail(field, f"be at most {maximum}", value)
    return value


def number(
    field: str,
    value: Any,
    *,
    above: float | None = None,
    at_least: float | None = None,
    below: float | None = None,
    at_most: float | None = None,
) -> float:
    """The value as a finite float within the bounds given."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        raise FieldTypeError(f"{field} must be a number, got {shown(value)}")
    try:
        value = float(value)
    except OverflowError:
        raise fail(field, "be finite", value) from None
    if not math.isfinite(value):
        raise fail(field, "be finite", value)
    if above is not None and not value > above:
        raise fail(field, f"be greater than {above:g}", value)
    if at_least is not None and not value >= at_least:
        raise fail(field, f"be at least {at_least:g}", value)
    if below is not None and not value < below:
        raise fail(field, f"be less than {below:g}", value)
    if at_most is not None and not value <= at_most:
        raise fail(field, f"be at most {at_most:g}", value)
    return value


def choice(field: str, value: Any, choices: Iterable[str]) -> str:
    """The value, if it is one of the choices."""
    choices = tuple(choices)
    if not isinstance(value, str):
        raise FieldTypeError(f"{field} must be a string, one of {', '.join(choices)}, got {shown(value)}")
    if value not in choices:
        raise fail(field, f"be one of {', '.join(choices)}", repr(value) + suggestion(value, choices))
    return value


def truth(field: str, value: Any) -> bool:
    """The value, if it is True or False."""
    if not isinstance(value, bool):
        raise FieldTypeError(f"{field} must be True or False, got {shown(value)}")
    return value


def instance(field: str, value: Any, *kinds: type) -> None:
    """An error unless the value is of one of the kinds."""
    if not isinstance(value, kinds):
        words = " or ".join("None" if kind is type(None) else with_article(kind.__name__) for kind in kinds)
        raise FieldTypeError(f"{field} must be {words}, got {shown(value)}")


def device(field: str, value: Any) -> torch.device:
    """The value as a device that this machine has: "cpu", "cuda" or "cuda:<number>"."""
    try:
        found = torch.empty(0, device=torch.device(value)).device
    except (RuntimeError, AssertionError, TypeError, ValueError) as error:
        raise fail(field, "be available here", f"{value!r}: {str(error).splitlines()[0][:100]}") from None
    if found.type not in ("cpu", "cuda"):
        raise fail(field, "be cpu, cuda or cuda:<number>", repr(value))
    return torch.device("cpu") if found.type == "cpu" else found


def table(field: str, value: Any) -> dict[str, Any]:
    """The value as a dictionary of its own, if it is a table."""
    if not isinstance(value, Mapping):
        raise FieldTypeError(f"{field} must be a table, got {shown(value)}")
    return dict(value)


def known_keys(field: str, given: Iterable[str], allowed: Iterable[str], within: Iterable[str] = ()) -> None:
    """An error that names the first key that is not allowed, and what of these, or of keys within them, may be meant."""
    allowed, within = tuple(allowed), tuple(within)
    for key in given:
        if key not in allowed:
            told = suggestion(key, (*within, *allowed)) if isinstance(key, str) else ""
            raise fail(field, f"have only the keys {', '.join(allowed) or '(none)'}", repr(key) + told)


def real_tensor(field: str, value: Any) -> Tensor:
    """The value as a finite tensor of float32 or float64 (float64 unless it is a tensor of either)."""
    if not isinstance(value, Tensor):
        value = _float64_tensor(field, value)
    if value.layout != torch.strided or value.device.type == "meta":
        raise FieldTypeError(f"{field} must be a dense tensor with data, got {value.layout} on {value.device}")
    if not value.is_floating_point():
        if value.is_complex() or value.dtype == torch.bool:
            raise FieldTypeError(f"{field} must be real floating-point numbers, got dtype {value.dtype}")
        value = value.to(torch.float64)
    if value.dtype not in (torch.float32, torch.float64):
        raise FieldTypeError(f"{field} must be of dtype float32 or float64, got {value.dtype}")
    finite(field, value)
    return value


def shaped(field: str, value: Any, shape: tuple[int, ...], like: str = "") -> Tensor:
    """The value as by :func:`real_tensor`, if it is of this shape, which is that ``like`` something."""
    value = real_tensor(field, value)
    if tuple(value.shape) != shape:
        raise fail(field, f"have shape {shape}{like}", value)
    return value


def is_transformed(values: Tensor) -> bool:
    """Whether ``torch.func.grad`` or ``vmap`` traces the tensor: its values are not to be looked at, and pass all checks."""
    try:
        values.data_ptr()
    except RuntimeError:  # what stands for values has no place in memory
        return True
    return False


class _Seen(torch.autograd.Function):
    """Hands on the values that are traced, once every transform is peeled off."""

    @staticmethod
    def forward(values: Tensor, keep: Callable[[Tensor], None]) -> Tensor:
        keep(values)
        return values.clone()

    @staticmethod
    def setup_context(*_: Any) -> None:
        """Nothing is kept: no gradient comes through here."""

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[int, None], values: Tensor, keep: Callable[[Tensor], None]
    ) -> tuple[Tensor, int]:
        return _Seen.apply(values.movedim(in_dims[0], 0), keep), 0


def traced_values(values: Tensor) -> Tensor:
    """The numbers inside what ``torch.func`` traces, with an axis in front for every ``vmap``; for bounds that hold for all."""
    if not is_transformed(values):
        return values
    held: list[Tensor] = []
    _Seen.apply(values.detach(), held.append)
    return held[0]


def finite(field: str, values: Tensor, axis: str = "position") -> Tensor:
    """The values, if all are finite numbers; one pass over them, where they are."""
    if not is_transformed(values) and not bool(values.detach().sum().isfinite()):  # also where only the sum overflows
        first_bad(field, "be finite", values, ~values.isfinite(), axis)
    return values


def _float64_tensor(field: str, value: Any) -> Tensor:
    """Numbers, nested lists or an array of them as a tensor; truth values and complex numbers are an error."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "iufO" or (array.dtype.kind == "O" and None in array):
            raise TypeError
        return torch.from_numpy(array.astype(np.float64, copy=True))
    except OverflowError:  # an integer beyond float64
        raise fail(field, "be finite", value) from None
    except (TypeError, ValueError, RuntimeError):
        raise FieldTypeError(f"{field} must be real numbers, got {shown(value)}") from None


def is_collection(value: Any) -> TypeGuard[Iterable[Any]]:
    """Whether the value is several values in an order: not a number, and not an array without axes."""
    return isinstance(value, Iterable) and getattr(value, "ndim", 1) != 0


def first_bad(field: str, rule: str, values: Tensor, bad: Tensor, axis: str = "position") -> None:
    """An error that names the first entry of ``values`` where ``bad`` holds: ``at realization 2, particle 17``."""
    where = first(bad)
    if where is not None:
        raise fail(field, rule, f"{values[where].item():.6g}{position(where, axis)}")


def first(condition: Tensor) -> tuple[int, ...] | None:
    """Index of the first entry at which a condition holds; None where it holds nowhere, or is traced."""
    if is_transformed(condition) or not bool(condition.any()):
        return None
    return tuple(int(i) for i in condition.nonzero()[0])


def position(index: tuple[int, ...], axis: str | None = None) -> str:
    """A tensor index as words counted from 1: leading axes are the realization, the last is ``axis`` if one is named."""
    if not index:
        return ""
    batch = index if axis is None else index[:-1]
    words = [f"realization {', '.join(str(i + 1) for i in batch)}"] if batch else []
    return " at " + ", ".join(words + ([] if axis is None else [f"{axis} {index[-1] + 1}"]))


def times(field: str, value: Any) -> Tensor:
    """Output times: one-dimensional, finite, not negative, strictly increasing, at least one."""
    value = real_tensor(field, value)
    if value.ndim != 1:
        raise fail(field, "be one-dimensional", value)
    if len(value) == 0:
        raise fail(field, "hold at least one time", "none")
    first_bad(field, "not be negative", value, value < 0)
    steps = value.diff()
    if bool((steps <= 0).any()):
        i = int((steps <= 0).nonzero()[0])
        raise fail(field, "increase strictly", f"{value[i].item():g} then {value[i + 1].item():g} at position {i + 2}")
    return value
