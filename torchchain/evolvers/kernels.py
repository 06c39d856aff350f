"""Whether Numba's kernels are compiled and loaded, and a word before they are compiled."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from torchchain.progress import log

_said = False


def loaded() -> bool:
    """Whether this process has loaded the kernels of method "chebyshev"."""
    return "torchchain.evolvers.stencil" in sys.modules


def in_cache(kernel: Any) -> bool:
    """Whether Numba can take a kernel from the folder that it has chosen for its cache, on this installation."""
    if kernel.stats.cache_path is None:
        return False
    source = Path(kernel.py_func.__code__.co_filename)
    found = Path(kernel.stats.cache_path).glob(f"{source.stem}.{kernel.py_func.__qualname__}-*.nbi")
    return any(index.stat().st_mtime >= source.stat().st_mtime for index in found)


def compiled() -> bool:
    """Whether the kernels of method "chebyshev" need no compiling; the answer takes loading Numba."""
    from torchchain.evolvers.stencil import march

    return bool(march.signatures) or in_cache(march)


def announce(kernel: Any) -> None:
    """Say that a kernel is about to be compiled, unless it is at hand; once in a process."""
    global _said
    if not (_said or kernel.signatures or in_cache(kernel)):
        _said = True
        log.warning("compiling kernels once, some 20 s ...")
