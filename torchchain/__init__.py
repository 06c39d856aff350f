"""Wave energy in disordered granular chains: exact ensembles and the master equation calibrated from them.

Names are loaded on first use, so that the command line answers before torch is imported; ``__init__.pyi`` lists them,
for type checkers and for this file.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from torchchain._version import __version__ as __version__


def _names() -> tuple[list[str], dict[str, tuple[str, str]]]:
    """The public names, and for each name that resolves its module and what it is called there."""
    shown: list[str] = []
    homes: dict[str, tuple[str, str]] = {}
    for entry in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body:
        if isinstance(entry, ast.ImportFrom) and entry.module:
            homes |= {name.asname or name.name: (entry.module, name.name) for name in entry.names}
        elif isinstance(entry, ast.Assign):
            shown = sorted(ast.literal_eval(entry.value))
    return shown, homes


__all__, _HOME = _names()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'torchchain' has no attribute '{name}'")
    home, original = _HOME[name]
    module = None if home == __name__ else import_module(home)
    value = getattr(module, original, None) or import_module(f"{home}.{original}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__", "energy", "master"]
