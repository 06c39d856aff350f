"""The file of a master equation: safetensors with a described header. Reading it imports and executes nothing."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from torchchain import checks
from torchchain._version import __version__
from torchchain.ensemble.scene import Scene
from torchchain.master.certificate import CertificateError, verify
from torchchain.master.fits import checked_window
from torchchain.master.ladder import kinds, methods
from torchchain.master.model import TransferModel
from torchchain.master.report import Calibration, Report
from torchchain.master.starts import StartModel
from torchchain.master.uncertainty import LATER, Uncertainty

FORMAT = "torchchain-master-equation"
FAMILY_FORMAT = "torchchain-master-family"
FORMATS = {
    FORMAT: "which has one strength of the disorder and takes none",
    FAMILY_FORMAT: "which takes a strength of the disorder (predict --strength, or MasterFamily.load(path).at(strength))",
}
"""What files of the two formats are to be told of where the other is wanted."""
MODEL = "model.safetensors"
"""What commands call such a file in a run's folder."""
FORMAT_VERSION = 3
CONVENTIONS = {
    "version": 1,  # of their meaning: wording may change without it
    "axes": "rates, basis and their stderr [source, receiver]; damping, delay [band]; amplitudes [function, source, receiver]; stderr [source, time, receiver]",
    "markov": "e(t) = e(0) (basis exp(-damping t) + (1 - basis) exp((rates - damping) t)), row vectors",
    "swing_in": "like markov, but energy moves only after it was released from rest with the rate 1 / delay",
    "memory": "e(t) = e(0) (basis + sum_m amplitudes[m] f_m(t)) exp(-damping t); f: exponentials, then cosine and sine of pairs; rates are slopes at short times, which e(t) does not use",
    "compact": "shares of a source's energy are the odds of damped beats of two waves, times exponentials of polynomials (coefficients) of place, distance and time, over their sum; of damped chains, of what is left of the energy, a mixture (loss) of damped modes; see torchchain.master.compact",
    "theory": "the transfer of torchchain.theory for the law of the masses (nodes and weights of its quadrature), a ring and tones, times exponentials of polynomials (coefficients) of place, distance and time, and with five degrees of beats of clusters of light particles, over their sum; see torchchain.master.derived",
    "bands": "n_bands equal bands of |k| in (0, pi]; tone n lies in band ceil(n / (n_particles / 2 / n_bands))",
    "units": "mean mass 1, linear contact stiffness 1; time: travel time of sound over one particle",
}
LARGEST_FILE = 2**28  # bytes
ERROR_AXES = {
    "rates_stderr": ("band", "band"), "basis_stderr": ("band", "band"),
    "stderr_times": ("time",), "stderr": ("band", "time", "band"), "misfit_share": ("part", "time", "band"),
    "alike": ("factor", "band", "time", "band"),
}  # fmt: skip
"""Of the error bars, which a file holds all or none of, but for those that older files do not know."""
LONGEST_AXIS = 128
"""Functions, or times of the error bars."""
MOST_TERMS, LONG_AXES = 2**14, ("term", "start_tone")
"""Of polynomials, and tones of a ring."""
MOST_MEMBERS = 64


Member = tuple[TransferModel, Calibration, Uncertainty | None, StartModel | None]
"""A model, how it was calibrated, its error bars, and the model of other starts."""
STARTS = "starts."
"""Before the names of the tensors of the latter, which a file holds all or none of."""


def save(member: Member, path: str | Path) -> None:
    """Write a model; the file appears whole or not at all."""
    model, record, uncertainty, starts = member
    _write(_described(model, record), _packed(model, uncertainty, starts), path)


def save_family(members: Sequence[Member], path: str | Path) -> None:
    """Write models for several strengths of the disorder in one file."""
    headers = [_described(model, record) for model, record, *_ in members]
    tensors = {
        f"{i}.{name}": value
        for i, (model, _, uncertainty, starts) in enumerate(members)
        for name, value in _packed(model, uncertainty, starts).items()
    }
    _write({"format": FAMILY_FORMAT, "format_version": FORMAT_VERSION, "members": headers}, tensors, path)


def _described(model: TransferModel, record: Calibration) -> dict[str, Any]:
    """The header of a model."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": model.kind,
        "n_bands": model.n_bands,
        "strength": record.strength,
        "method": record.method,
        "model": record.model,
        "rates_meaning": model.rates_meaning,
        "window": record.window,
        "scene": None if record.scene is None else record.scene.to_dict(),
        "provenance": record.provenance,
        "report": _proved(model, record.report).to_dict(),
        "conventions": CONVENTIONS,
        "versions": {
            "torchchain": __version__,
            **{name: version(name) for name in ("torch", "numpy", "scipy", "torchdiffeq")},
        },
    }


def _proved(model: TransferModel, report: Report) -> Report:
    """The report, without a certificate that the model no longer meets (in single precision, or changed by hand)."""
    if report.certificate is None:
        return report
    try:
        verify(model, report.certificate)
    except CertificateError:
        return replace(report, certificate=None)
    return report


def _packed(
    model: TransferModel, uncertainty: Uncertainty | None, starts: StartModel | None
) -> dict[str, torch.Tensor]:
    every = model.tensors() | (uncertainty.tensors() if uncertainty is not None else {})
    every |= {} if starts is None else {STARTS + name: value for name, value in starts.tensors().items()}
    return {name: value.detach().cpu().contiguous() for name, value in every.items()}


def _write(header: Mapping[str, Any], tensors: dict[str, torch.Tensor], path: str | Path) -> None:
    try:
        metadata = {"torchchain": json.dumps(header, sort_keys=True, allow_nan=False)}
    except ValueError:  # everything else in the header has been checked
        raise checks.fail("calibration.report", "hold finite numbers", header.get("report")) from None
    checks.instance("path", path, str, os.PathLike)
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        os.close(handle)
        try:
            save_file(tensors, temporary, metadata=metadata)
            os.chmod(temporary, 0o644)
            os.replace(temporary, path)
        except BaseException:
            os.unlink(temporary)
            raise
    except (OSError, SafetensorError, ValueError) as error:
        raise checks.fail(f"file {path}", "be writable", f"{getattr(error, 'strerror', None) or error}") from None


def load(path: str | Path) -> Member:
    """Read and check a file written by :func:`save`, or that in a run's folder."""
    return _load(path, FORMAT)[0]


def load_family(path: str | Path) -> list[Member]:
    """Read and check a file written by :func:`save_family`, or that in a run's folder."""
    return _load(path, FAMILY_FORMAT)


def _load(path: str | Path, expected: str) -> list[Member]:
    checks.instance("path", path, str, os.PathLike)
    path = Path(path)
    where = f"file {path}"
    try:
        if path.is_dir() and (path / MODEL).is_file():
            return _load(path / MODEL, expected)
        size = path.stat().st_size
        if not path.is_file():
            raise checks.fail(where, "be a file", "a folder or device" + f" (without {MODEL})" * path.is_dir())
        if size > LARGEST_FILE:
            raise checks.fail(where, f"be at most {LARGEST_FILE} bytes", size)
        with safe_open(path, framework="pt") as file:
            headers = _headers(where, file.metadata() or {}, expected)
            tensors = _tensors(where, file, headers, expected)
    except OSError as error:
        raise checks.fail(where, "be a readable file", f"{error.strerror or error}") from None
    except (SafetensorError, ValueError, TypeError, KeyError, OverflowError, MemoryError, RecursionError) as error:
        if isinstance(error, checks.FieldError):
            raise
        raise checks.fail(where, "be a master equation saved by torchchain", checks.shown(str(error))) from None
    return [_member(where, header, found) for header, found in zip(headers, tensors, strict=True)]


def _member(where: str, header: dict[str, Any], tensors: dict[str, torch.Tensor]) -> Member:
    """A model, its record and its error bars from checked header and tensors."""
    try:
        errors = {name: tensors.pop(name) for name in ERROR_AXES if name in tensors}
        uncertainty = Uncertainty.from_tensors(**errors) if errors else None
        others = {name: tensors.pop(STARTS + name) for name in StartModel.AXES if STARTS + name in tensors}
        starts = StartModel(**others, n_bands=header["n_bands"]) if others else None
        model = kinds()[header["kind"]](**tensors)
        scene = None if header["scene"] is None else Scene.from_dict(header["scene"])
        window = None if header["window"] is None else checked_window(header["window"])
        fit = methods().get(header["method"])
        report = Report.from_dict(header["report"], None if fit is None else fit.report)
        if report.loss is not None and len(report.loss.rates) != model.n_bands:
            raise checks.fail("report.loss.rates", f"hold {model.n_bands} numbers", report.loss.rates)
        if report.certificate is not None:
            with np.errstate(all="ignore"):  # of energies that are no numbers nothing is proved
                verify(model, report.certificate)
    except (checks.FieldError, checks.FieldTypeError, CertificateError, TypeError) as error:
        raise checks.fail(where, "hold valid fields", f"{error}") from None
    bands = model.n_bands if scene is None else scene.n_bands
    if bands != model.n_bands or header["n_bands"] != model.n_bands:
        raise checks.fail(where, "have as many bands in its scene as in its rates", f"{bands} and {model.n_bands}")
    record = Calibration(header["method"], header["model"], window, scene, report, header["provenance"])
    if header["strength"] != record.strength:
        raise checks.fail(where, "state the strength of its scene", header["strength"])
    return model, record, uncertainty, starts


def _headers(where: str, metadata: Mapping[str, str], expected: str) -> list[dict[str, Any]]:
    """The checked headers of the models of a file."""
    if "torchchain" not in metadata:
        raise checks.fail(where, f"carry the format {expected}", "no such header")
    header = json.loads(metadata["torchchain"])
    if not isinstance(header, dict) or header.get("format") != expected:
        other = header.get("format") if isinstance(header, dict) else header
        told = FORMATS.get(other) if isinstance(other, str) else None
        raise checks.fail(where, f"carry the format {expected}", f"{other}, {told}" if told else checks.shown(header))
    if expected == FORMAT:
        return [_header(where, header)]
    _check_version(where, header)
    members = header.get("members")
    if not isinstance(members, list) or not 1 <= len(members) <= MOST_MEMBERS:
        raise checks.fail(where, f"have 1 to {MOST_MEMBERS} members", checks.shown(members))
    return [_header(where, member) for member in members]


def _check_version(where: str, header: Mapping[str, Any]) -> None:
    found = header.get("format_version")
    if found != FORMAT_VERSION or isinstance(found, bool):
        raise checks.fail(where, f"have format version {FORMAT_VERSION} (calibrate again for another)", found)


def _header(where: str, header: Any) -> dict[str, Any]:
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise checks.fail(where, f"carry the format {FORMAT}", checks.shown(header))
    _check_version(where, header)
    fields: dict[str, tuple[type, ...]] = {
        "kind": (str,),
        "n_bands": (int,),
        "strength": (int, float, type(None)),
        "method": (str,),
        "model": (str,),
        "rates_meaning": (str,),
        "window": (list, type(None)),
        "scene": (dict, type(None)),
        "provenance": (str,),
        "report": (dict,),
        "conventions": (dict,),
        "versions": (dict,),
    }
    for name, types in fields.items():
        if name not in header or not isinstance(header[name], types) or isinstance(header[name], bool):
            raise checks.fail(
                where, f"have a header field {name} of type {types[0].__name__}", header.get(name, "nothing")
            )
    if header["conventions"].get("version") != CONVENTIONS["version"]:
        rule = f"follow version {CONVENTIONS['version']} of the conventions"
        raise checks.fail(where, rule, checks.shown(header["conventions"].get("version", "none")))
    checks.choice(f"{where}: kind", header["kind"], kinds())
    return header


def _tensors(where: str, file: Any, headers: Sequence[Mapping[str, Any]], form: str) -> list[dict[str, torch.Tensor]]:
    """The tensors of every model of a file, no more and no less than the headers say."""
    names, found = set(file.keys()), []
    for i, header in enumerate(headers):
        prefix = "" if form == FORMAT else f"{i}."
        own = {name for name in names if name.startswith(prefix)}
        names -= own
        found.append(_model_tensors(where, file, header, prefix, own))
    if names:
        raise checks.fail(where, f"hold the tensors of {len(headers)} models", checks.shown(sorted(names)[:4]))
    return found


def _model_tensors(
    where: str, file: Any, header: Mapping[str, Any], prefix: str, names: set[str]
) -> dict[str, torch.Tensor]:
    kind = kinds()[header["kind"]]
    expected = {n: axes for n, axes in kind.axes.items() if n not in kind.optional or prefix + n in names}
    if any(prefix + name in names for name in ERROR_AXES):
        needed = [n for n in ERROR_AXES if n not in LATER or prefix + n in names]
        expected = expected | {name: ERROR_AXES[name] for name in needed}
    if any(name.startswith(prefix + STARTS) for name in names):
        needed = [n for n in StartModel.AXES if n not in StartModel.OPTIONAL or prefix + STARTS + n in names]
        expected = expected | {STARTS + name: StartModel.AXES[name] for name in needed}
    if names != {prefix + name for name in expected}:
        wanted = ", ".join(sorted(prefix + name for name in expected))
        raise checks.fail(where, f"hold the tensors {wanted}", checks.shown(sorted(names)[:4]))
    tensors = {}
    for name, axes in expected.items():
        part = file.get_slice(prefix + name)
        shape = tuple(part.get_shape())
        fits = len(shape) == len(axes) and all(
            size == header["n_bands"] if axis == "band" else size <= (MOST_TERMS if axis in LONG_AXES else LONGEST_AXIS)
            for size, axis in zip(shape, axes, strict=True)
        )
        if not fits:
            raise checks.fail(
                where, f"hold {name} of shape ({', '.join(axes)}) with {header['n_bands']} bands", f"shape {shape}"
            )
        if part.get_dtype() not in ("F64", "F32"):
            raise checks.fail(where, f"hold {name} as 32 or 64 bit floating point", part.get_dtype())
        tensors[name] = file.get_tensor(prefix + name)
    return tensors
