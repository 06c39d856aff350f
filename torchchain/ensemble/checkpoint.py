"""Finished realizations of a run kept on disk, so that a run killed at any moment goes on where it stopped.

What is kept are not results of realizations but the nodes of their moments (:class:`statistics.MomentTree`), some
log2(R) of them however many realizations are in, and which realizations are in follows from the nodes. The order in
which nodes merge depends on realization numbers alone: a run that was killed and went on gives the same bits as one
that was not.

A folder holds *parts*, a file for each process and session, replaced as a whole at each save. The next session merges
them into one. Each part carries a SHA-256 of all that is in it and the settings of its run.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from torchchain import checks
from torchchain.ensemble.statistics import EnsembleMoments, joined
from torchchain.locks import lock
from torchchain.progress import log

FORMAT = "torchchain-checkpoint-1"
EVERY = 5.0  # seconds between saves
SAVING = 20  # takes at most one part in so many of the time
_NAME = re.compile(r"(\d{5})-(\d{5}|base)\.safetensors")


class CheckpointWarning(UserWarning):
    """A checkpoint that could not be read or written; the run goes on without it.

    Example:
        >>> import warnings
        >>> warnings.simplefilter("error", tc.CheckpointWarning)  # stop rather than go on without a checkpoint
    """


class Interrupted(KeyboardInterrupt):
    """Ctrl-C or a signal to end, with what was kept."""


@dataclass(frozen=True)
class Kept:
    """What earlier sessions left: their moments, the plan they followed (None if none), and this session's number."""

    moments: EnsembleMoments
    plan: dict[str, Any] | None = None
    session: int = 1


class Checkpoint:
    """A folder that keeps the finished realizations of one run.

    Runs shorter than ``every`` seconds leave nothing. A later run of the same settings goes on from the folder; one of
    others is refused.

    Args:
        folder: made when there is something to keep.
        every: seconds between saves, longer where saving takes long; 0 saves after every chunk.

    Attributes:
        resumed: realizations that the present run took over.

    Example:
        >>> from tempfile import mkdtemp
        >>> scene = tc.Scene(n_particles=16, n_bands=2, realizations=8, times=[0.0, 1.0])
        >>> kept = tc.Checkpoint(mkdtemp(), every=0)
        >>> first = tc.band_transfer(scene, method="modes", checkpoint=kept)
        >>> again = tc.band_transfer(scene, method="modes", checkpoint=kept)  # from the folder, to the last bit
        >>> torch.equal(first.mean, again.mean)
        True
    """

    def __init__(self, folder: str | Path, every: float = EVERY) -> None:
        checks.instance("checkpoint", folder, str, Path)
        self.folder = Path(folder)
        self.every = checks.number("checkpoint_every", every, at_least=0)
        self.resumed = 0

    def read(self, identity: Mapping[str, Any], realizations: int, n_blocks: int, sample_size: int = 1) -> Kept:
        """What earlier sessions of this run left, merged into one part.

        Args:
            identity: the run's settings, plain values.
            realizations, n_blocks, sample_size: of its :class:`EnsembleMoments`.

        Raises:
            FieldError: naming the first setting that differs from those of the folder.
        """
        total = EnsembleMoments(realizations, n_blocks, sample_size)
        try:
            parts = self._parts()
        except OSError as error:
            raise checks.fail("checkpoint", "be readable", f"{self.folder}: {error.strerror or error}") from None
        plan = None
        for part in parts:
            self._compare(part.header["identity"], _as_json(identity))
            plan = plan or part.header["plan"]
        names = []
        for part in parts:
            try:
                moments = total.again(part.tensors)
                joined([*total.held(), *moments.held()])  # an error where two overlap
            except (ValueError, KeyError) as error:
                self._discard(part.path, str(error))
                continue
            total.absorb(moments)
            names.append(part.path.name)
        self.resumed = sum(map(len, total.held()))
        if self.resumed:
            log.info(f"{self.resumed} of {realizations} realizations are in {self.folder}: going on from there")
        session = 1 + max((int(part.path.name[:5]) for part in parts), default=0)
        if len(names) > 1:
            self._merge(total, names, session, identity, plan)
        return Kept(total, plan, session)

    def writer(self, session: int, rank: int, identity: Mapping[str, Any], plan: Mapping[str, Any] | None) -> Writer:
        """What saves the moments of one process in this session."""
        header = {"identity": _as_json(identity), "plan": plan and _as_json(plan), "replaces": []}
        return Writer(self, self.folder / f"{session:05d}-{rank:05d}.safetensors", header)

    def clear(self) -> None:
        """Remove the parts, once the results are elsewhere, and the folder if nothing else is in it."""
        with suppress(OSError):
            for path in self.folder.iterdir():
                if path.is_dir():  # of a run that belongs to this one
                    Checkpoint(path).clear()
                elif _NAME.fullmatch(path.name.removesuffix(".tmp")):
                    path.unlink(missing_ok=True)
            self.folder.rmdir()

    def lock(self) -> AbstractContextManager[None]:
        """Hold the folder while a run reads and writes it; another run's is a FieldError that names it."""
        return lock(self.folder, "checkpoint")

    def _parts(self) -> list[_Part]:
        """The whole parts in the folder, without those that another one replaces."""
        found = []
        for path in sorted(self.folder.glob("*")):
            if path.name.endswith(".tmp") and _NAME.fullmatch(path.name[:-4]):
                path.unlink(missing_ok=True)  # a save that did not come to its end
            elif _NAME.fullmatch(path.name):
                try:
                    found.append(_read(path))
                except ValueError as damage:
                    self._discard(path, str(damage))
        replaced = {name for part in found for name in part.header["replaces"]}
        for name in replaced:
            (self.folder / name).unlink(missing_ok=True)
        return [part for part in found if part.path.name not in replaced]

    def _discard(self, path: Path, why: str) -> None:
        warnings.warn(
            f"checkpoint {path} is damaged ({why}): its realizations are computed again",
            CheckpointWarning,
            stacklevel=2,
        )
        path.unlink(missing_ok=True)

    def _compare(self, old: Mapping[str, Any], new: Mapping[str, Any]) -> None:
        before, now = _flat(old), _flat(new)
        for name in [*now, *(name for name in before if name not in now)]:
            if before.get(name) != now.get(name):
                raise checks.fail(
                    name,
                    f"stay {checks.shown(before.get(name))} as in the unfinished run in {self.folder} "
                    "(remove that folder to begin anew)",
                    checks.shown(now.get(name)),
                )

    def _merge(
        self, total: EnsembleMoments, names: list[str], session: int, identity: Mapping[str, Any], plan: Any
    ) -> None:
        """One part in place of several; a kill at any moment leaves one or the other."""
        header = {"identity": _as_json(identity), "plan": plan, "replaces": names}
        try:
            _write(self.folder / f"{session:05d}-base.safetensors", header, total.tensors())
        except OSError:
            return  # they go on being several
        for name in names:
            (self.folder / name).unlink(missing_ok=True)


@dataclass
class Writer:
    """Saves the moments of one process, now and then."""

    checkpoint: Checkpoint
    path: Path
    header: dict[str, Any]
    kept: int = 0
    cost: float = 0.0
    last: float = field(default_factory=time.monotonic)

    @property
    def due(self) -> bool:
        """Whether it is time to save again."""
        every = self.checkpoint.every
        return time.monotonic() - self.last >= (max(every, SAVING * self.cost) if every else 0.0)

    def save(self, moments: EnsembleMoments) -> None:
        """Save now; a failure is a warning, and what was saved before stays."""
        begin = time.monotonic()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            _write(self.path, self.header, moments.tensors())
            self.kept = sum(map(len, moments.held()))
        except OSError as error:
            warnings.warn(
                f"checkpoint {self.path.parent} could not be written: {error.strerror or error}; the run goes on",
                CheckpointWarning,
                stacklevel=2,
            )
        self.last = time.monotonic()
        self.cost = self.last - begin

    def close(self, moments: EnsembleMoments) -> None:
        """Save before a wait or a failure, if the run has lasted long enough to."""
        if moments.trees and (self.kept or self.checkpoint.resumed or self.due):
            self.save(moments)

    def interrupted(self, moments: EnsembleMoments) -> Interrupted:
        """Keep what is finished, if the run has lasted long enough to, and say what is kept."""
        self.close(moments)
        kept = self.checkpoint.resumed + self.kept
        if not kept:
            return Interrupted("interrupted, nothing was written")
        held = f"{kept} of {moments.realizations} realizations are kept in {self.path.parent}"
        return Interrupted(f"interrupted: {held}, the same command goes on from there")


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold back Ctrl-C and the signal to end until the block is done: half-merged moments could not be saved."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[int] = []
    chosen = [s for s in (signal.SIGINT, signal.SIGTERM) if callable(signal.getsignal(s))]
    before = {s: signal.signal(s, lambda number, _: held.append(number)) for s in chosen}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if held:
            signal.raise_signal(held[0])


@dataclass(frozen=True)
class _Part:
    path: Path
    header: dict[str, Any]
    tensors: dict[str, Tensor]


def _read(path: Path) -> _Part:
    """A part, checked to be what was written; a ValueError says why it is not."""
    try:
        content = path.read_bytes()
        size = int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8 : 8 + size])["__metadata__"]
        tensors = load(content)
        text, digest = metadata["header"], metadata["sha256"]
    except (SafetensorError, ValueError, KeyError, TypeError, OverflowError) as error:
        raise ValueError(f"no whole file: {checks.shown(str(error), 60)}") from None
    if digest != _digest(text, tensors):
        raise ValueError("its checksum differs")
    header = json.loads(text)
    if header.get("format") != FORMAT:
        raise ValueError(f"its format is not {FORMAT}")
    return _Part(path, header, tensors)


def _write(path: Path, header: Mapping[str, Any], tensors: dict[str, Tensor]) -> None:
    """The file appears whole or not at all, whatever happens to the process or the machine."""
    text = json.dumps({"format": FORMAT, **header}, sort_keys=True)
    content = save(tensors, {"header": text, "sha256": _digest(text, tensors)})
    temporary = path.with_name(path.name + ".tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise
    with suppress(OSError):  # not every system lets a folder be opened
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 of header, names, shapes and numbers."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        values = tensors[name].detach()
        digest.update(f"\n{name} {values.dtype} {tuple(values.shape)}\n".encode())
        digest.update(values.contiguous().view(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _as_json(value: Any) -> Any:
    """The value as JSON would give it back."""
    return json.loads(json.dumps(value, default=checks.shown))


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    plain: dict[str, Any] = {}
    for name, value in table.items():
        if isinstance(value, Mapping):
            plain |= _flat(value, f"{prefix}{name}.")
        else:
            plain[prefix + name] = value
    return plain
