"""What a long computation says of itself: named progress bars and one-line notices."""

from __future__ import annotations

import logging
from typing import Any

from tqdm.auto import tqdm

log = logging.getLogger("torchchain")
"""Notices ("compiling kernels ..."): the command line prints them, a library user sees those of level WARNING."""


def bar(name: str, total: int | None, unit: str, shown: bool, initial: int = 0) -> Any:
    """A named progress bar, on a terminal or in a notebook; hidden elsewhere, and where it is not to be shown."""
    return tqdm(total=total, initial=initial, desc=name, unit=unit, disable=None if shown else True, leave=False)
