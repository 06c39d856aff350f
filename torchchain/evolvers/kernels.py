"""Whether Numba's kernels are compiled, and a word before they are compiled."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchchain.progress import log

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
