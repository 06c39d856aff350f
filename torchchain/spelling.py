"""What a misspelled name was meant to be."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

SYNONYMS = {
    "xi": "strength", "sigma": "strength", "disorder": "strength", "dt": "step", "end": "stop", "begin": "start",
    "n": "n_particles", "particles": "n_particles", "bands": "n_bands", "chains": "realizations", "samples": "realizations",
    "centre": "center", "position": "site", "ring": "periodic", "open": "fixed", "hertzian": "hertz", "gaussian": "normal",
    "kick": "impulse", "sine": "sin", "cosine": "cos", "eigh": "modes", "leapfrog": "verlet",
    "output": "out", "bond_energy": "energy", "spectrum": "wavenumber_energy",
}  # fmt: skip
"""Words of the field, and what the names here are for them."""


def meant(word: str, names: Iterable[str]) -> str | None:
    """The one of the names that a person who wrote ``word`` most likely meant, or None."""
    plain = word.lower().replace("-", "_").lstrip("_")
    last: dict[str, str] = {}  # the last part of a dotted name stands for it: strength for disorder.strength
    for name in names:
        key = name.lower().replace("-", "_").lstrip("_")
        last[key] = name
        last.setdefault(key.rpartition(".")[2], name)
    for wanted in (plain, SYNONYMS.get(plain), SYNONYMS.get(plain.rpartition(".")[2])):
        if wanted in last:
            return last[wanted]
    close = difflib.get_close_matches(plain, last, 1, 0.72)
    return last[close[0]] if close else None


def suggestion(word: str, names: Iterable[str]) -> str:
    """``; did you mean NAME?``, or nothing."""
    found = meant(word, names)
    return f"; did you mean {found}?" if found else ""
