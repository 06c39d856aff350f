"""Whether Numba's kernels are compiled, and a word before they are compiled."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Any

from numba.core import event

from torchchain.progress import bar, log

_seen: set[int] = set()
_said = False


def at_hand(kernel: Any) -> bool:
    """Whether a kernel is compiled, in this process or in the folder that Numba has chosen for its cache here."""
    if kernel.signatures:
        return True
    if kernel.stats.cache_path is None:
        return False
    source = Path(kernel.py_func.__code__.co_filename)
    found = Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in found)


def announce(kernel: Any) -> None:
    """Say that a kernel is about to be compiled, unless it is at hand; once in a process."""
    global _said
    if _said or id(kernel) in _seen:
        return
    _seen.add(id(kernel))  # kernels are never collected
    if not at_hand(kernel):
        _said = True
        log.warning("compiling kernels once, some 20 s ...")
        threading.Thread(target=_count, daemon=True).start()


IDLE = 2.0
"""Seconds without a kernel being compiled after which there is none left, it is taken."""


class _Compiling(event.Listener):
    """Whether Numba is compiling, as it says itself."""

    def __init__(self) -> None:
        self.open, self.last = 0, time.monotonic()

    def on_start(self, event: event.Event) -> None:
        self.open += 1

    def on_end(self, event: event.Event) -> None:
        self.open, self.last = self.open - 1, time.monotonic()

    @property
    def ended(self) -> bool:
        return self.open <= 0 and time.monotonic() - self.last > IDLE


def _count() -> None:
    """Count the seconds on a terminal while kernels are compiled."""
    with event.install_listener("numba:compile", _Compiling()) as compiling, bar("compiling", None, "s", True) as shown:
        while not compiling.ended:
            time.sleep(1.0)
            shown.update(1)
