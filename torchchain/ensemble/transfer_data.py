"""A band transfer as a dataset with labeled axes and units, and back."""

from __future__ import annotations

import json
import tomllib
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchchain import checks
from torchchain._version import __version__
from torchchain.ensemble.block_means import decoded, encoded
from torchchain.ensemble.labels import scene_attributes, tensor_of, time_coordinates
from torchchain.ensemble.provenance import Provenance
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.starts import StartTransfer

if TYPE_CHECKING:
    import xarray

    from torchchain.ensemble.transfer import BandTransfer

OF_RUNS = ("mass_mean", "mass_sd", "start_condition")
"""Attributes of a transfer from runs of another code."""


def dataset_of(transfer: BandTransfer) -> xarray.Dataset:
    """Variables, coordinates and attributes of a transfer."""
    import xarray

    s, t, r, b = "source", "time", "receiver", "block"
    variables: dict[str, Any] = {}

    def put(name: str, axes: tuple[str, ...], values: Tensor | None, label: str) -> None:
        if values is not None:
            variables[name] = (axes, values.numpy(), {"units": "1", "long_name": label})

    put("band_energy", (s, t, r), transfer.mean, "share of the energy in the receiving band")
    put("band_energy_stderr", (s, t, r), transfer.stderr, "its standard error")
    whole = encoded(transfer.block_mean, transfer.mean, transfer.stderr, transfer.block_counts)
    if whole is None:
        put("block_band_energy", (b, s, t, r), transfer.block_mean, "block means")
    else:
        label = {"units": "1", "long_name": "block means as integers, which BandTransfer.load understands"}
        variables["block_steps"] = ((b, s, t, r), whole, label, {"zlib": True, "complevel": 4})
    put("block_count", (b,), torch.tensor(transfer.block_counts), "realizations in a block")
    if transfer.long_time is not None:
        put("long_time", (s, r), transfer.long_time, "infinite-time average of the share")
        put("long_time_stderr", (s, r), transfer.long_time_stderr, "its standard error")
        put("block_long_time", (b, s, r), transfer.block_long_time, "block means")
    put("systematic", (s, t), transfer.systematic, "estimated total variation distance from an endless ensemble")
    if transfer.starts is not None:
        variables |= transfer.starts.variables()
    bands = np.arange(1, transfer.n_bands + 1)
    coords = {
        **time_coordinates(transfer.times, transfer.scene.si if transfer.scene is not None else None),
        s: (s, bands, {"long_name": "band s of the initial standing wave"}),
        r: (r, bands, {"long_name": "receiving band r"}),
    }
    assert transfer.provenance is not None
    origin = {
        "provenance_kind": transfer.provenance.kind,
        "provenance": transfer.provenance.words,
        "provenance_hashes": json.dumps(transfer.provenance.hashes),
    }
    of_scene = {"torchchain_version": __version__} if transfer.scene is None else scene_attributes(transfer.scene)
    return xarray.Dataset(variables, coords=coords, attrs=of_scene | transfer.attributes | origin)


def fields_of(data: xarray.Dataset) -> dict[str, Any]:
    """The fields of the transfer that a dataset holds, checked."""
    import xarray

    checks.instance("data", data, xarray.Dataset)
    whole = "block_steps" in data
    needed = ("band_energy", "band_energy_stderr", "block_steps" if whole else "block_band_energy", "block_count")
    late = ("long_time", "long_time_stderr", "block_long_time") if "long_time" in data else ()
    for name in (*needed, *late):
        if name not in data:
            raise checks.fail("data", f"hold the variable {name} of a band transfer", f"{', '.join(map(str, data))}")
    kept = ("method", "method_options", "start_condition")
    attributes = {name: data.attrs[name] for name in kept if name in data.attrs}
    scene = None
    if "scene" in data.attrs or "provenance_kind" not in data.attrs:
        scene, moments = _scene_of(data)
        attributes |= moments
    else:
        attributes |= {name: checks.number(f"data.{name}", data.attrs[name]) for name in OF_RUNS if name in data.attrs}

    tensor = partial(tensor_of, data)
    mean, stderr = tensor("band_energy"), tensor("band_energy_stderr")
    counts = tuple(checks.integer("data.block_count", n, 1) for n in np.atleast_1d(data["block_count"].values))
    return {
        "scene": scene,
        "times": tensor("time") if scene is None else scene.times,
        "mean": mean,
        "stderr": stderr,
        **{name: tensor(name) if late else None for name in ("long_time", "long_time_stderr", "block_long_time")},
        "block_mean": _decoded(data, mean, stderr, counts) if whole else tensor("block_band_energy"),
        "block_counts": counts,
        "attributes": attributes,
        "provenance": _provenance_of(data),
        "systematic": tensor("systematic") if "systematic" in data else None,
        "starts": StartTransfer.from_dataset(data),
    }


def _decoded(data: xarray.Dataset, mean: Tensor, stderr: Tensor, counts: tuple[int, ...]) -> Tensor:
    """The block means of a file that holds them as whole steps."""
    missed = data["block_steps"].values
    if missed.dtype.kind != "i":
        raise checks.FieldTypeError(f"data.block_steps must be of integers, got {missed.dtype}")
    expected = (len(counts), *mean.shape)
    if mean.ndim != 3 or missed.shape != expected or stderr.shape != mean.shape:
        raise checks.fail("data.block_steps", f"have shape {expected}", f"shape {missed.shape}")
    return decoded(missed, mean.double(), stderr.double(), counts)


def _scene_of(data: xarray.Dataset) -> tuple[Scene, dict[str, Any]]:
    """The scene of a simulation's dataset, and the moments of its masses."""
    for name in ("scene", "mass_mean", "mass_sd"):
        if name not in data.attrs:
            raise checks.fail("data", f"have the attribute {name} of a band transfer", "none")
    try:
        scene = Scene.from_dict(tomllib.loads(str(data.attrs["scene"])))
    except (ValueError, RecursionError) as error:
        raise checks.fail("data", "have the attribute scene of a band transfer", str(error)) from None
    if "time" in data.coords and not np.array_equal(data["time"].values, scene.times.numpy()):
        raise checks.fail("data", "have the times of its scene", checks.shown(data["time"].values))
    return scene, {name: checks.number(f"data.{name}", data.attrs[name]) for name in ("mass_mean", "mass_sd")}


def _provenance_of(data: xarray.Dataset) -> Provenance | None:
    """What a dataset says of its origin; None in files written before they did."""
    if "provenance_kind" not in data.attrs:
        return None
    try:
        hashes = json.loads(str(data.attrs.get("provenance_hashes", "{}")))
    except ValueError as error:
        raise checks.fail("data", "have the attribute provenance_hashes as JSON", str(error)) from None
    return Provenance(str(data.attrs["provenance_kind"]), str(data.attrs.get("provenance", "")), hashes)
