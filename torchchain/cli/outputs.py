"""The folder of a run: every file whole or absent, with a record of how it was made."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchchain import checks, plots
from torchchain.cli import report
from torchchain.ensemble.ranks import rank_of_environment
from torchchain.locks import lock
from torchchain.progress import log

if TYPE_CHECKING:
    import xarray

PACKAGES = ("torchchain", "torch", "numpy", "scipy", "torchdiffeq", "safetensors", "xarray", "h5netcdf", "matplotlib")
COMPRESSION: dict[str, Any] = {"zlib": True, "complevel": 1, "shuffle": True}
LARGE, LARGEST_PIECE, MOST_PIECES = 2**18, 2**22, 64
"""Bytes of values that are cut along their last axis, of a piece at most, and pieces at most."""
DPI = 200
RECORD = "run.json"
"""Written last and removed first: where it is, all that it names is of one run."""
Writer = Callable[[Path], object]


def load() -> None:
    """Import what results are drawn and written with, half a second, while something else goes on."""
    for name in ("xarray", "h5netcdf", "scipy.interpolate", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        import_module(name)


@contextmanager
def run_folder(out: str | Path) -> Iterator[Path]:
    """The output folder, found writable before hours of work and held against other runs until this one ends."""
    out = check_writable(out)
    if rank_of_environment():  # the first process of a group holds it for all
        yield out
        return
    with lock(out, "out"):
        yield out


def check_apart(out: str | Path, *inputs: str | Path) -> None:
    """An error for an output folder that holds an input and the record of its run, which would be replaced."""
    for path in map(Path, inputs):
        folder = path if path.is_dir() else path.parent
        if (folder / RECORD).is_file() and Path(out).resolve() == folder.resolve():
            raise checks.fail("out", "be another folder than that of the input, whose record would be lost", str(out))


def check_writable(out: str | Path) -> Path:
    """The output folder's path; an error now if nothing can be written there."""
    if not str(out).strip():
        raise checks.fail("out", "be a folder", repr(str(out)))
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


@contextmanager
def staging(out: str | Path) -> Iterator[Path]:
    """A folder aside for what is written before the rest is known; gone when this ends, whatever :func:`write` did not move."""
    with _reported(Path(out)):
        out = Path(out).absolute()
        out.parent.mkdir(parents=True, exist_ok=True)
        # A folder of the user's own may lie where nothing else can be written.
        aside = out if out.exists() else out.parent
        _clear_staging(aside, out.name)
        prefix = f".{out.name[:100]}.{os.getpid()}-"
        folder = Path(tempfile.mkdtemp(prefix=prefix, suffix=".part", dir=aside))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write(out: str | Path, writers: dict[str, Writer], aside: Path | None = None) -> None:
    """Write all files aside first, then move them in: a run that dies leaves nothing half-written.

    Args:
        out: the folder, made with its parents; files of the same names in it are replaced, the record last.
        writers: for each file name a function that writes to the path it is given.
        aside: of :func:`staging` for the same folder, where it was asked for before; writers of files that lie there already
            wait for them.
    """
    if aside is None:
        with staging(out) as folder:
            write(out, writers, folder)
        return
    log.info("writing %s", out)
    with _reported(Path(out)):
        out = Path(out).absolute()
        for name, writer in writers.items():
            writer(aside / name)
        aside.chmod(0o755)
        if out.exists():
            if RECORD in writers:  # no old record beside new data
                (out / RECORD).unlink(missing_ok=True)
            for name in writers:
                os.replace(aside / name, out / name)
        else:
            os.rename(aside, out)


def _clear_staging(folder: Path, name: str) -> None:
    """Remove what killed runs into the folder of this name left: theirs to the letter, and of no living process."""
    own = re.compile(re.escape(f".{name[:100]}.") + r"(\d+)-[a-z0-9_]{8}\.part")
    for path in folder.iterdir():
        found = own.fullmatch(path.name)
        if found and not _is_alive(int(found[1])):
            shutil.rmtree(path, ignore_errors=True)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # of another user
        pass
    return True


def text(content: str) -> Writer:
    """A writer of a text file."""
    return lambda path: path.write_text(content, encoding="utf-8")


def dataset(data: xarray.Dataset) -> Writer:
    """A writer of a netCDF file; numbers are compressed without loss."""

    def writer(path: Path) -> None:
        _require_room(path, data.nbytes)
        numbers = {
            name: values for name, values in data.data_vars.items() if values.ndim and values.dtype.kind in "fiu"
        }
        encoding = {name: {**COMPRESSION, **_cut(values), **values.encoding} for name, values in numbers.items()}
        data.to_netcdf(path, engine="h5netcdf", encoding=encoding)

    return writer


def _cut(values: xarray.DataArray) -> dict[str, Any]:
    """Of large values over time and one more axis: all times in one piece, next to one another, take a twentieth less room."""
    if values.dims[-2:-1] != ("time",) or values.nbytes < LARGE:
        return {}
    piece = -(-values.shape[-1] // MOST_PIECES)
    if values.nbytes // values.shape[-1] * piece > LARGEST_PIECE:
        return {}
    return {"chunksizes": (*values.shape[:-1], piece), "complevel": 6}


def _require_room(path: Path, size: int) -> None:
    """An OSError if the disk has no room for a file of this size: HDF5 can crash where it runs out of it."""
    if not hasattr(os, "posix_fallocate"):
        return
    with open(path, "wb") as file:
        os.posix_fallocate(file.fileno(), 0, size + 2**16)


def figure(drawn: Any) -> Writer:
    """A writer of a matplotlib figure, in the format of the file's ending."""

    def writer(path: Path) -> None:
        with plots.style():  # colors and ticks are made as it is drawn
            layout = drawn.get_layout_engine()
            if layout is not None:  # laid out here, once: to save it so would draw all of it a second time
                drawn.set_dpi(DPI)
                layout.execute(drawn)
                drawn.set_layout_engine(None)
            drawn.savefig(path, dpi=DPI)

    return writer


def figures(drawn: Any, kind: str = "png") -> dict[str, Writer]:
    """The figure as PNG, which the report shows, and in the other format that is asked for."""
    return {f"figure.{ending}": figure(drawn) for ending in dict.fromkeys(("png", kind))}


@contextmanager
def told_warnings() -> Iterator[list[str]]:
    """The warnings that are shown until this ends, in words, for the record; they are shown all the same."""
    told: list[str] = []
    show = warnings.showwarning

    def noted(message: Warning | str, *where: Any, **more: Any) -> None:
        told.append(" ".join(str(message).split()))
        show(message, *where, **more)

    warnings.showwarning = noted
    try:
        yield told
    finally:
        warnings.showwarning = show


def reported(
    out: Path, arguments: Sequence[str], config: str, device: str, began: float, stages: dict[str, float], **more: Any
) -> dict[str, Writer]:
    """The writers of report.html and of run.json, to be written last: what is needed to make the run again, and to know it again.

    Args:
        out: the folder of the run.
        arguments: the command, recorded with the folder it was given in.
        config: its resolved settings, of which a hash is recorded, as of all files.
        device: recorded with versions, threads and git revision.
        began, stages: seconds.
        more: further fields of the record, those that :func:`report.page` tells among them.
    """
    record = {
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

    def page(path: Path) -> None:
        text(report.page({**record, "out": str(out.absolute())}, path.parent))(path)

    def writer(path: Path) -> None:
        hashes = {beside.name: sha256(beside) for beside in sorted(path.parent.iterdir())}
        text(json.dumps(_strict({**record, "files": hashes}), indent=2, allow_nan=False) + "\n")(path)

    return {report.REPORT: page, RECORD: writer}


def leave(
    out: Path, files: dict[str, Writer], arguments: Sequence[str], config: str, *known: Any, aside: Path | None = None,
    **more: Any,
) -> None:  # fmt: skip
    """Write the config, if it says anything, the files, and what :func:`reported` gives of the rest; see :func:`write`."""
    written = reported(out, arguments, config, *known, **more)
    write(out, {**({"config.toml": text(config)} if config else {}), **files, **written}, aside)


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
