"""Observables, methods and models from outside: what the user names, and what installed packages announce."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from torchchain import checks

GROUP = "torchchain"
"""Of entry points: a package that announces a module in it has that module imported before any command runs."""
_loaded: set[Path] = set()


def load(names: Iterable[str]) -> list[str]:
    """Import the plugins, each a Python file or a module, and those of installed packages.

    Returns:
        The names as a later run from another folder needs them: files as absolute paths.

    Raises:
        FieldError: naming the plugin that cannot be imported, and why.
    """
    for entry in entry_points(group=GROUP):
        _reported(f"{entry.name} of an installed package", entry.load)
    return [_load(name) for name in names]


def of_config(given: Any) -> tuple[str, ...]:
    """The list ``plugins`` of a config file."""
    if not isinstance(given, (list, tuple)) or not all(isinstance(name, str) and name for name in given):
        raise checks.FieldTypeError(f"plugins must be a list of files or modules, got {checks.shown(given)}")
    return tuple(given)


def _load(name: str) -> str:
    path = Path(name)
    if path.suffix != ".py" and not path.exists() and os.sep not in name:
        folder = os.getcwd()
        if folder not in sys.path:
            sys.path.append(folder)
        _reported(name, lambda: importlib.import_module(name))
        return name
    if not path.is_file():
        raise checks.fail("plugin", "be a Python file or a module", f"no file {name}")
    path = path.resolve()
    if path not in _loaded:  # registered once, however often the command runs in a process
        _reported(name, lambda: _run(path))
        _loaded.add(path)
    return str(path)


def _run(path: Path) -> None:
    spec = importlib.util.spec_from_file_location(f"torchchain_plugin_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # for pickling and dataclasses
    spec.loader.exec_module(module)


def _reported(name: str, load: Any) -> None:
    """Whatever a plugin raises is one line that names it; an end that it asks for, too."""
    try:
        load()
    except (Exception, SystemExit) as error:
        raise checks.fail("plugin", "be importable", f"{name}: {type(error).__name__}: {error}") from None
