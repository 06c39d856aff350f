"""Thread count for small products."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def single_thread() -> Iterator[None]:
    """Run on one thread, then restore the number.

    Products of matrices of some 32 rows gain nothing from more threads, and wait for them where other processes
    hold the cores: 60 times slower was measured beside a busy process.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
