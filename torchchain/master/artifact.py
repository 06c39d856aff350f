"""The file of a master equation: safetensors with a described header. Reading it imports and executes nothing."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from torchchain import checks
from torchchain.master.memory import MemoryModel
from torchchain.master.model import RateModel, TransferModel
from torchchain.scene import Scene

FORMAT = "torchchain-master-equation"
FORMAT_VERSION = 1
CONVENTIONS = {
    "axes": "rates, basis [source, receiver]; damping [band]; amplitudes [function, source, receiver]",
    "markov": "e(t) = e(0) (basis exp(-damping t) + (1 - basis) exp((rates - damping) t)), row vectors",
    "memory": "e(t) = e(0) (basis + sum_m amplitudes[m] f_m(t)) exp(-damping t); f: exponentials, then cosine and sine of pairs",
    "bands": "n_bands equal bands of |k| in (0, pi]; tone n lies in band ceil(n / (n_particles / 2 / n_bands))",
    "units": "mean mass 1, linear contact stiffness 1; time: travel time of sound over one particle",
}
LARGEST_FILE = 2**28
MODELS: dict[str, type[TransferModel]] = {RateModel.kind: RateModel, MemoryModel.kind: MemoryModel}
AXES: dict[str, dict[str, tuple[str, ...]]] = {
    RateModel.kind: {"rates": ("band", "band"), "basis": ("band", "band"), "damping": ("band",)},
    MemoryModel.kind: {
        "rates": ("band", "band"), "basis": ("band", "band"), "damping": ("band",),
        "amplitudes": ("function", "band", "band"), "decay": ("function",),
        "pair_decay": ("function",), "pair_frequency": ("function",),
    },
}  # fmt: skip
MOST_FUNCTIONS = 64


def save(model: TransferModel, record: Mapping[str, Any], path: str | Path) -> None:
    """Write model and record; the file appears whole or not at all."""
    import numpy
    import scipy
    import torchdiffeq

    from torchchain import __version__

    scene: Scene = record["scene"]
    header = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "kind": model.kind,
        "n_bands": model.n_bands,
        "strength": scene.disorder.strength,
        "method": record["method"],
        "model": record["model"],
        "window": record["window"],
        "scene": scene.to_dict(),
        "report": record["report"],
        "conventions": CONVENTIONS,
        "versions": {
            "torchchain": __version__,
            "torch": torch.__version__,
            "numpy": numpy.__version__,
            "scipy": scipy.__version__,
            "torchdiffeq": torchdiffeq.__version__,
        },
    }
    try:
        metadata = {"torchchain": json.dumps(header, sort_keys=True, allow_nan=False)}
    except ValueError:  # everything else in the header has been checked
        raise checks.fail("calibration.report", "hold finite numbers", record["report"]) from None
    tensors = {name: value.detach().cpu().contiguous() for name, value in model.tensors().items()}
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


def load(path: str | Path) -> tuple[TransferModel, dict[str, Any]]:
    """Read and check a file written by :func:`save`."""
    path = Path(path)
    where = f"file {path}"
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise checks.fail(where, "be a file", "a folder or device")
        if size > LARGEST_FILE:
            raise checks.fail(where, f"be at most {LARGEST_FILE} bytes", size)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            header = _header(where, metadata)
            tensors = _tensors(where, file, header)
    except OSError as error:
        raise checks.fail(where, "be a readable file", f"{error.strerror or error}") from None
    except (SafetensorError, ValueError, TypeError, KeyError, OverflowError, MemoryError, RecursionError) as error:
        if isinstance(error, checks.FieldError):
            raise
        raise checks.fail(where, "be a master equation saved by torchchain", checks.shown(str(error))) from None
    try:
        model = MODELS[header["kind"]](**tensors)
        scene = Scene.from_dict(header["scene"])
        window = None if header["window"] is None else _window(header["window"])
    except (checks.FieldError, checks.FieldTypeError, TypeError) as error:
        raise checks.fail(where, "hold valid fields", f"{error}") from None
    if scene.n_bands != model.n_bands or header["n_bands"] != model.n_bands:
        raise checks.fail(
            where, "have as many bands in its scene as in its rates", f"{scene.n_bands} and {model.n_bands}"
        )
    if header["strength"] != scene.disorder.strength:
        raise checks.fail(where, "state the strength of its scene", header["strength"])
    return model, {
        "method": header["method"],
        "model": header["model"],
        "window": window,
        "scene": scene,
        "report": header["report"],
    }


def _header(where: str, metadata: Mapping[str, str]) -> dict[str, Any]:
    if "torchchain" not in metadata:
        raise checks.fail(where, f"carry the format {FORMAT}", "no such header")
    header = json.loads(metadata["torchchain"])
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise checks.fail(where, f"carry the format {FORMAT}", checks.shown(header))
    version = header.get("format_version")
    if version != FORMAT_VERSION or isinstance(version, bool):
        raise checks.fail(where, f"have format version {FORMAT_VERSION}", version)
    kinds: dict[str, tuple[type, ...]] = {
        "kind": (str,),
        "n_bands": (int,),
        "strength": (int, float),
        "method": (str,),
        "model": (str,),
        "window": (list, type(None)),
        "scene": (dict,),
        "report": (dict,),
        "conventions": (dict,),
        "versions": (dict,),
    }
    for name, types in kinds.items():
        if name not in header or not isinstance(header[name], types) or isinstance(header[name], bool):
            raise checks.fail(
                where, f"have a header field {name} of type {types[0].__name__}", header.get(name, "nothing")
            )
    if header["conventions"] != CONVENTIONS:
        raise checks.fail(where, "follow this version's conventions", checks.shown(header["conventions"]))
    checks.choice(f"{where}: kind", header["kind"], MODELS)
    return header


def _tensors(where: str, file: Any, header: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    expected = AXES[header["kind"]]
    names = set(file.keys())
    if names != set(expected):
        raise checks.fail(where, f"hold the tensors {', '.join(sorted(expected))}", checks.shown(sorted(names)[:4]))
    tensors = {}
    for name, axes in expected.items():
        part = file.get_slice(name)
        shape = tuple(part.get_shape())
        fits = len(shape) == len(axes) and all(
            size == header["n_bands"] if axis == "band" else size <= MOST_FUNCTIONS
            for size, axis in zip(shape, axes, strict=True)
        )
        if not fits:
            raise checks.fail(
                where, f"hold {name} of shape ({', '.join(axes)}) with {header['n_bands']} bands", f"shape {shape}"
            )
        if part.get_dtype() not in ("F64", "F32"):
            raise checks.fail(where, f"hold {name} as 32 or 64 bit floating point", part.get_dtype())
        tensors[name] = file.get_tensor(name)
    return tensors


def _window(value: list[Any]) -> tuple[float, float]:
    if len(value) != 2:
        raise checks.fail("window", "be two times", value)
    begin = checks.number("window", value[0], at_least=0)
    return begin, checks.number("window", value[1], above=begin)
