"""What the commands that run an ensemble share: scene and folder from the flags, threads, what is kept of an interrupted run."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from torchchain import checks
from torchchain.cli import outputs
from torchchain.cli.flags import Calibrate, SceneFlags, Simulate
from torchchain.ensemble import ranks
from torchchain.ensemble.checkpoint import Checkpoint, Interrupted
from torchchain.ensemble.scene import Scene, read_toml
from torchchain.evolvers import METHODS


@contextmanager
def threads_for(number: int | None) -> Iterator[None]:
    """Run on as many threads as asked for, or on a fair share of the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(ranks.fair_threads() if number is None else checks.integer("threads", number, 1, 4096))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def keeping(checkpoint: Checkpoint | None) -> Iterator[None]:
    """An interrupt after the ensemble is done tells of the realizations that are kept."""
    try:
        yield
    except Interrupted:
        raise
    except KeyboardInterrupt:
        if checkpoint is None or not checkpoint.folder.exists():
            raise
        raise Interrupted(
            f"interrupted: finished realizations are kept in {checkpoint.folder}, the same command goes on from there"
        ) from None


def merged_tables(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables, the second over the first; an excitation of another kind replaces the first's fields."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            kind = value.get("kind", old.get("kind"))
            replaced = key == "excitation" and kind != old.get("kind", "standing_wave")
            merged[key] = dict(value) if replaced else merged_tables(old, value)
        else:
            merged[key] = value
    return merged


def scene_of(flags: SceneFlags, tables: tuple[str, ...] = ()) -> tuple[Scene, dict[str, Any]]:
    """The scene of config file and flags, and the config's further tables."""
    config = read_toml(flags.config) if flags.config is not None else {}
    extra = {name: config.pop(name) for name in tables if name in config}
    given = flags.overrides()
    if isinstance(given.get("times"), Mapping) and not isinstance(config.get("times"), Mapping):
        config["times"] = {"start": 0.0, "stop": 50.0, "step": 0.25}
    return Scene.from_dict(merged_tables(config, given)), extra


def out_and_device(flags: Simulate | Calibrate) -> tuple[Path, str]:
    """Folder and device of a run over an ensemble, and its method, checked before anything is computed."""
    out = outputs.check_writable(flags.out)
    device = str(checks.device("device", ranks.own_device(flags.device)))
    checks.choice("method", flags.method, ("auto", *METHODS))
    return out, device


def how(
    flags: Simulate | Calibrate, attributes: Mapping[str, Any], group: ranks.Ranks, checkpoint: Checkpoint | None
) -> dict[str, Any]:
    """What the record says of an ensemble: the method asked for and the one used, processes, what was taken over."""
    return {
        "method": flags.method,
        "resolved": {"method": attributes["method"], "options": json.loads(attributes["method_options"])},
        "processes": group.size,
        "resumed_realizations": checkpoint.resumed if checkpoint is not None else 0,
        "realized": {name: attributes[name] for name in ("mass_mean", "mass_sd")},
    }
