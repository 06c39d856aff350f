"""What the commands share: scene and folder from the flags, threads, plugins, what is kept of an interrupted run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tomli_w
import torch

from torchchain import checks
from torchchain.cli import choices, outputs, plugins
from torchchain.cli.flags import Calibrate, RunFlags, SceneFlags
from torchchain.ensemble import plan as planning
from torchchain.ensemble import ranks
from torchchain.ensemble.checkpoint import Checkpoint, Interrupted
from torchchain.ensemble.measured_transfer import THEORY
from torchchain.ensemble.scene import Scene
from torchchain.ensemble.scene_file import TIMES, read_toml
from torchchain.ensemble.stages import Stages
from torchchain.evolvers import METHODS
from torchchain.threads import meanwhile

Measured = TypeVar("Measured")


@contextmanager
def threads_for(number: int | None) -> Iterator[None]:
    """Run on as many threads as asked for, or on a fair share of the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(ranks.fair_threads() if number is None else checks.integer("threads", number, 1, 4096))
    try:
        yield
    finally:
        torch.set_num_threads(before)


@dataclass
class Run:
    """A command over an ensemble, from its start to its record.

    Attributes:
        flags, arguments: of the command.
        out: its folder, held against other runs.
        device: checked.
        plugins: that were loaded.
        options: of the method, where a record is followed.
        checkpoint: None where nothing is to be kept.
        warned: the warnings so far, in words.
    """

    flags: RunFlags
    arguments: list[str]
    out: Path
    device: str
    plugins: list[str]
    options: dict[str, Any] | None
    checkpoint: Checkpoint | None
    stages: Stages = field(default_factory=Stages)
    began: float = field(default_factory=time.time)
    spent: float = 0.0
    group: ranks.Ranks = ranks.ALONE
    warned: list[str] = field(default_factory=list)

    def measured(self, measure: Callable[..., Measured], scene: Scene) -> Measured | None:
        """What :func:`simulate` or :func:`band_transfer` finds, on the first of the processes that share the work."""
        with meanwhile(outputs.load, torch.get_num_threads()), ranks.process_group(self.device) as self.group:
            before = time.time()
            found = measure(
                scene, self.flags.method, device=self.device, progress=True, stages=self.stages, options=self.options,
                checkpoint=self.checkpoint, ranks=self.group,
            )  # fmt: skip
            self.spent = time.time() - before
        return None if self.group.rank else found

    def how(self, scene: Scene, attributes: Mapping[str, Any]) -> dict[str, Any]:
        """What the record says of the ensemble: the method asked for and the one used, why, processes, what was taken over."""
        return {
            "method": self.flags.method,
            "reasons": self._reasons(scene, attributes["method"]),
            "resolved": {"method": attributes["method"], "options": json.loads(attributes["method_options"])},
            "processes": self.group.size,
            "resumed_realizations": self.checkpoint.resumed if self.checkpoint is not None else 0,
            "realized": {name: attributes[name] for name in ("mass_mean", "mass_sd")},
        }

    def _reasons(self, scene: Scene, used: str) -> list[str]:
        if self.flags.method != "auto":
            return [f"'{used}' was asked for"]
        plan = planning.plan(scene)
        return list(plan.reasons) if plan.method == used else [f"'{used}' was begun with, and kept"]

    def config(self, *tables: str) -> str:
        """The resolved config: the plugins, and the tables of the run."""
        head = [tomli_w.dumps({"plugins": self.plugins})] if self.plugins else []
        return "\n".join([*head, *tables])

    def write(
        self, files: dict[str, outputs.Writer], config: str, aside: Path | None = None, **record: Any
    ) -> None:  # fmt: skip
        """Leave the files, the config and the record in the folder, and clear the checkpoint; see :func:`outputs.leave`."""
        hashes = {name: outputs.sha256(name) for name in self.plugins if name.endswith(".py")}
        with self.stages("writing"):
            outputs.leave(
                self.out, files, self.arguments, config, self.device, self.began, self.stages.seconds,
                aside=aside, warnings=self.warned, **({"plugins": hashes} if self.plugins else {}), **record,
            )  # fmt: skip
        if self.checkpoint is not None:
            self.checkpoint.clear()

    def told(self, forecast: Mapping[str, Any] | None) -> None:
        """Print how long the ensemble took, and what it was expected to take."""
        if forecast is not None:
            print(planning.forecast_line(forecast))


@contextmanager
def running(
    flags: RunFlags, arguments: list[str], loaded: list[str], options: dict[str, Any] | None, keep: bool
) -> Iterator[Run]:
    """A run whose flags are checked and whose folder is its own; an interrupt tells of what is kept."""
    began = time.time()
    device = str(checks.device("device", ranks.own_device(flags.device)))
    checks.choice("format", flags.format, choices.FIGURES)
    checks.choice("method", flags.method, ("auto", *METHODS, *([THEORY] if isinstance(flags, Calibrate) else [])))
    with outputs.run_folder(flags.out) as out, outputs.told_warnings() as told:
        checkpoint = Checkpoint(out / "checkpoint", flags.checkpoint_every) if keep else None
        try:
            yield Run(flags, arguments, out, device, loaded, options, checkpoint, began=began, warned=told)
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


def config_of(path: str | None, named: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """The config file without its list of plugins, and the plugins of file and flags, loaded."""
    config = read_toml(path) if path is not None else {}
    listed = plugins.of_config(config.pop("plugins", []))
    return config, plugins.load(dict.fromkeys([*listed, *named]))


def scene_of(config: dict[str, Any], flags: SceneFlags) -> Scene:
    """The scene of config file and flags."""
    given = flags.overrides()
    if isinstance(given.get("times"), Mapping) and not isinstance(config.get("times"), Mapping):
        config = {**config, "times": TIMES}
    return Scene.from_dict(merged_tables(config, given))
