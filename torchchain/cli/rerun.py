"""Make a run again from the record in its folder, and compare all data bit by bit."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from torchchain import checks
from torchchain.cli import outputs
from torchchain.cli.calibrate import run_calibrate
from torchchain.cli.flags import Calibrate, Import, Predict, Rerun, Simulate
from torchchain.cli.imports import run_import
from torchchain.cli.predict import run_predict
from torchchain.cli.simulate import run_simulate
from torchchain.ensemble import ranks
from torchchain.ensemble.scene_file import read_toml
from torchchain.results import read_dataset

DATA = {
    "simulate": ("results.nc",),
    "calibrate": ("transfer.nc", "model.safetensors"),
    "predict": ("results.nc",),
    "import": ("transfer.nc",),
}
NEEDED: dict[str, type] = {"files": dict, "versions": dict, "device": str, "config_sha256": str}
NEEDED_OF: dict[str, dict[str, type]] = {
    "predict": {"method": str, "model.path": str, "model.sha256": str},
    "import": {"inputs": dict},
    "ensemble": {"resolved.method": str, "resolved.options": dict},
    "transfer": {"transfer.path": str, "transfer.sha256": str},
}
SAID_ELSEWHERE = ("torchchain_version",)  # attributes that the record's versions hold


def rerun(flags: Rerun, arguments: list[str]) -> int:
    """Make a run again and say what differs; returns 0 if nothing does, else 1.

    The scene comes from the folder's resolved config.toml and the method with its options from its record, so that a
    plan that would choose otherwise on this machine changes nothing.

    Raises:
        FieldError: if the folder holds no whole record, or a file that the run needs has changed.
    """
    folder = Path(flags.folder)
    record = read_record(folder)
    command = record["arguments"][0]
    if flags.out is not None and Path(flags.out).resolve() == folder.resolve():
        raise checks.fail("out", "be another folder than the one that is made again", flags.out)
    with _place(flags.out) as out:
        _again(record, folder, out, flags)
        if ranks.rank_of_environment():
            return 0
        differences = [line for name in DATA[command] for line in compared(folder / name, out / name)]
        for line in notes(record, json.loads((out / "run.json").read_text()), folder):
            print(f"note: {line}")
    for line in differences:
        print(f"differs: {line}")
    if not differences:
        print(f"{', '.join(DATA[command])}: equal to the last bit")
    if flags.out is not None:
        print(f"new run in {flags.out}")
    return int(bool(differences))


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a run, checked to be of a command that can be run again and to fit the config beside it."""
    where = f"folder {folder}"
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        config = (folder / "config.toml").read_bytes()
    except OSError as error:
        raise checks.fail(
            where, "hold the run.json and config.toml of a run", f"{error.strerror}: {error.filename}"
        ) from None
    except (ValueError, RecursionError) as error:
        raise checks.fail(f"{where}/run.json", "be JSON", str(error)) from None
    arguments = record.get("arguments") if isinstance(record, dict) else None
    if not isinstance(arguments, list) or not arguments or arguments[0] not in DATA or "files" not in record:
        raise checks.fail(where, f"hold a run of {', '.join(DATA)}", checks.shown(arguments))
    source = NEEDED_OF["transfer" if "transfer" in record else "ensemble"]
    for name, kind in (NEEDED | NEEDED_OF.get(arguments[0], source)).items():
        held: Any = record
        for key in name.split("."):
            held = held.get(key) if isinstance(held, dict) else None
        if not isinstance(held, kind):
            raise checks.fail(f"{where}/run.json", f"hold {name} as {kind.__name__}", checks.shown(held))
    if hashlib.sha256(config).hexdigest() != record["config_sha256"]:
        raise checks.fail(f"{folder}/config.toml", "be the one that the run left", "a changed file")
    for name in DATA[arguments[0]]:
        if not (folder / name).is_file():
            raise checks.fail(where, f"hold {name} to compare with", "no such file")
    return record


@contextlib.contextmanager
def _place(out: str | None) -> Iterator[Path]:
    """The folder of the new run: the one asked for, or one that is discarded."""
    if out is not None:
        yield Path(out)
        return
    with tempfile.TemporaryDirectory(prefix="torchchain-rerun-") as scratch:
        yield Path(scratch) / "again"


def _again(record: Mapping[str, Any], folder: Path, out: Path, flags: Rerun) -> None:
    """The recorded command with the resolved config, method and options."""
    arguments, keep, resolved = record["arguments"], flags.out is not None, record.get("resolved", {})
    device = flags.device or record["device"].partition(": ")[0]
    how: dict[str, Any] = {"config": str(folder / "config.toml"), "out": str(out), "device": device}
    with contextlib.redirect_stdout(io.StringIO()):
        if arguments[0] == "import":
            for path, digest in record["inputs"].items():
                _same_file("inputs", {"path": path, "sha256": digest})
            words = read_toml(folder / "config.toml")
            run_import(Import(**words | {"runs": tuple(words["runs"]), "out": str(out)}), arguments)
        elif arguments[0] == "predict":
            model = _same_file("model", record["model"])
            run_predict(Predict(model, method=record["method"], seed=record["seed"], **how), arguments)
        elif "transfer" in record:
            run_calibrate(Calibrate(transfer=_same_file("transfer", record["transfer"]), **how), arguments)
        elif arguments[0] == "simulate":
            run_simulate(Simulate(method=resolved["method"], **how), arguments, resolved["options"], keep)
        else:
            run_calibrate(Calibrate(method=resolved["method"], **how), arguments, resolved["options"], keep)


def _same_file(name: str, recorded: Mapping[str, str]) -> str:
    """The file that a run was given, checked to be the same."""
    path = Path(recorded["path"])
    if not path.is_file():
        raise checks.fail(name, f"be where the run found it, with SHA-256 {recorded['sha256']}", f"no file {path}")
    found = outputs.sha256(path)
    if found != recorded["sha256"]:
        raise checks.fail(name, f"have the SHA-256 {recorded['sha256']} of the run", f"{found} in {path}")
    return str(path)


def compared(old: Path, new: Path) -> list[str]:
    """What differs between two files of data, one line for each variable."""
    before, now = _variables(old), _variables(new)
    lines = [f"{old.name}: {name} is missing in the new run" for name in before if name not in now]
    lines += [f"{old.name}: {name} is new" for name in now if name not in before]
    for name in before:
        if name in now and (line := difference(before[name], now[name])):
            lines.append(f"{old.name}: {name} {line}")
    return lines


def difference(old: np.ndarray, new: np.ndarray) -> str:
    """How two arrays differ, in words; empty if they are the same to the last bit."""
    if old.dtype != new.dtype or old.shape != new.shape:
        return f"was {old.dtype} {old.shape}, is {new.dtype} {new.shape}"
    if old.dtype.kind not in "fc":
        return "" if np.array_equal(old, new) else f"was {checks.shown(old.tolist())}, is {checks.shown(new.tolist())}"
    if old.tobytes() == new.tobytes():
        return ""
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(abs(new - old), nan=0.0, posinf=np.inf)
        changed = int((~((old == new) | (np.isnan(old) & np.isnan(new)))).sum())
        finite = abs(old[np.isfinite(old)])
    return (
        f"has {changed} of {old.size} numbers changed, by up to {apart.max():.3g} "
        f"(its largest is {finite.max() if finite.size else np.nan:.3g})"
    )


def _variables(path: Path) -> dict[str, np.ndarray]:
    """Everything that a file says, by name: variables, coordinates and attributes, or tensors."""
    if path.suffix == ".safetensors":
        try:
            return dict(load_file(path))
        except Exception as error:  # whatever the library says of a broken file
            raise checks.fail(f"file {path}", "be a readable data file", checks.shown(str(error))) from None
    data = read_dataset(path)
    plain = {str(name): np.asarray(values.values) for name, values in data.variables.items()}
    attributes = {f"attribute {name}": np.asarray(value) for name, value in data.attrs.items()}
    return plain | {name: value for name, value in attributes.items() if name.split()[-1] not in SAID_ELSEWHERE}


def notes(before: Mapping[str, Any], now: Mapping[str, Any], folder: Path) -> list[str]:
    """What was different around the two runs, for the one who looks for a reason."""
    lines = [
        f"{name} has changed since the run"
        for name, digest in before["files"].items()
        if (folder / name).is_file() and outputs.sha256(folder / name) != digest
    ]
    for name in sorted(before["versions"].keys() | now["versions"].keys()):
        old, new = (record["versions"].get(name, "none") for record in (before, now))
        if old != new:
            lines.append(f"{name} was {old}, is {new}")
    changed = [name for name, digest in before.get("plugins", {}).items() if now.get("plugins", {}).get(name) != digest]
    lines += [f"plugin {name} has changed since the run" for name in changed]
    for name in ("device", "machine", "git_revision"):
        if before.get(name) != now.get(name):
            lines.append(f"{name} was {before.get(name)}, is {now.get(name)}")
    return lines
