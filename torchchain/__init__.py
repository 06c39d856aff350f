"""Wave energy in disordered granular chains: exact ensembles and the master equation calibrated from them.

Names are loaded on first use, so that the command line answers before torch is imported; ``__init__.pyi`` lists them,
for type checkers and for this file.
"""

from __future__ import annotations

from torchchain._version import __version__ as __version__

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


def _read_names() -> None:
    """The names at the top, the rooms of all others, and for each name that resolves its module and what it is called there."""
    import ast
    from pathlib import Path

    shown: list[str] = []
    rooms = ["localization"]
    homes: dict[str, tuple[str, str]] = {}
    for entry in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body:
        if isinstance(entry, ast.ImportFrom) and entry.module:
            homes |= {name.asname or name.name: (entry.module, name.name) for name in entry.names}
            rooms += [name.name for name in entry.names if entry.module == __name__]
        elif isinstance(entry, ast.Assign):
            shown = sorted(ast.literal_eval(entry.value))
    globals().update(__all__=shown, _HOME=homes, _ROOMS=rooms)


def __getattr__(name: str) -> Any:
    from importlib import import_module

    if "_HOME" not in globals():
        _read_names()
    if name in ("__all__", "_HOME", "_ROOMS"):
        return globals()[name]
    if name not in globals()["_HOME"]:
        from sys import modules

        words = f"module 'torchchain' has no attribute '{name}'"
        raise AttributeError(words, name=name, obj=modules[__name__])  # Python then says what may be meant
    home, original = globals()["_HOME"][name]
    module = None if home == __name__ else import_module(home)
    value = getattr(module, original, None) or import_module(f"{home}.{original}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__getattr__("__all__"), *__getattr__("_ROOMS"), "__version__"]
