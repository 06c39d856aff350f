"""Seconds spent in the stages of a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stages:
    """Seconds spent in each named stage of a run.

    Args:
        weight: of the seconds that are counted: one over their number for work on several threads.

    Example:
        >>> stages = tc.ensemble.Stages()
        >>> _ = tc.simulate(tc.Scene(n_particles=16, n_bands=4, realizations=2, times=[1.0]), "modes", stages=stages)
        >>> "eigen-decomposition" in stages.seconds
        True
    """

    def __init__(self, weight: float = 1.0) -> None:
        self.weight = weight
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add({name: self.weight * (time.perf_counter() - begin)})

    def add(self, seconds: dict[str, float]) -> None:
        """Take in the seconds of other stages."""
        for name, value in seconds.items():
            self.seconds[name] = self.seconds.get(name, 0.0) + value
