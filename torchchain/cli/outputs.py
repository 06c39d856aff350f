"""The folder of a run: every file whole or absent, with a record of how it was made."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
import xarray

from torchchain import checks

PACKAGES = ("torchchain", "torch", "numpy", "scipy", "torchdiffeq", "safetensors", "xarray", "h5netcdf", "matplotlib")
Writer = Callable[[Path], None]


def check_writable(out: str | Path) -> Path:
    """The output folder's path; an error now, before hours of work, if nothing can be written there."""
    out = Path(out)
    with _reported(out):
        if os.path.lexists(out) and not out.is_dir():
            raise checks.fail("out", "be a folder", str(out))
        parent = out
        while not _is_there(parent):
            parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise checks.fail("out", "be writable", str(out))
    return out


def _is_there(path: Path) -> bool:
    """Whether something has this path; any reason but its absence is an error."""
    try:
        path.lstat()
    except FileNotFoundError:
        return False
    except ValueError as error:  # a null byte
        raise checks.fail("out", "be writable", f"{str(path)!r}: {error}") from None
    return True


@contextmanager
def _reported(out: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise checks.fail("out", "be writable", f"{out}: {error.strerror or error}") from None


def write(out: str | Path, writers: dict[str, Writer]) -> None:
    """Write all files beside the folder first, then move them in: a run that dies leaves nothing half-written.

    Args:
        out: the folder, made with its parents; files of the same names in it are replaced.
        writers: for each file name a function that writes to the path it is given.
    """
    out = Path(out)
    with _reported(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        for beside in list(out.parent.iterdir()):  # what killed runs left
            if beside.name.startswith(f".{out.name}.") and beside.name.endswith(".part"):
                shutil.rmtree(beside, ignore_errors=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
        try:
            for name, writer in writers.items():
                writer(staging / name)
            staging.chmod(0o755)
            if out.exists():
                for name in writers:
                    os.replace(staging / name, out / name)
                staging.rmdir()
            else:
                os.rename(staging, out)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise


def text(content: str) -> Writer:
    """A writer of a text file."""

    def writer(path: Path) -> None:
        path.write_text(content, encoding="utf-8")

    return writer


def dataset(data: xarray.Dataset) -> Writer:
    """A writer of a netCDF file."""

    def writer(path: Path) -> None:
        _require_room(path, data.nbytes)
        data.to_netcdf(path, engine="h5netcdf")

    return writer


def _require_room(path: Path, size: int) -> None:
    """An OSError if the disk has no room for a file of this size: HDF5 can crash where it runs out of it."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(path, "wb") as file:
        os.posix_fallocate(file.fileno(), 0, size + 2**16)


def figure(drawn: Any) -> Writer:
    """A writer of a matplotlib figure, as PNG."""

    def writer(path: Path) -> None:
        drawn.savefig(path, dpi=150)

    return writer


def run_record(
    arguments: Sequence[str], config: str, device: str, began: float, stages: dict[str, float], **more: Any
) -> Writer:
    """A writer of run.json, to be written last: what is needed to make the run again, and to know it again.

    Command and folder it was given in, hashes of config and files, versions, device, threads, durations, git revision.
    """
    record: dict[str, Any] = {
        "command": shlex.join(["torchchain", *arguments]),
        "arguments": list(arguments),
        "working_directory": os.getcwd(),
        "config_sha256": hashlib.sha256(config.encode()).hexdigest(),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}},
        "device": device if device == "cpu" else f"{device}: {torch.cuda.get_device_name(device)}",
        "machine": platform.machine(),
        "threads": torch.get_num_threads(),
        "started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(began)),
        "seconds": round(time.time() - began, 3),
        "stages": {name: round(seconds, 3) for name, seconds in stages.items()},
        "git_revision": _git_revision(),
        **more,
    }

    def writer(path: Path) -> None:
        record["files"] = {beside.name: sha256(beside) for beside in sorted(path.parent.iterdir())}
        path.write_text(json.dumps(_strict(record), indent=2, allow_nan=False) + "\n", encoding="utf-8")

    return writer


def sha256(path: str | Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _strict(value: Any) -> Any:
    """The value with infinite and undefined numbers as words, for which JSON has no numbers."""
    if isinstance(value, dict):
        return {name: _strict(entry) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(entry) for entry in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


def _git_revision() -> str | None:
    """The revision of the source tree the package is imported from, if it is one."""
    folder = Path(__file__).resolve().parent.parent
    if not (folder / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
