"""The memory of this machine."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import torch


def memory(device: torch.device) -> int:
    """Bytes that this process may ever hold on a device: what the machine has, or the limit of its control group."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[1]
    return _own()


@cache
def _own() -> int:
    """:func:`memory` of the processor, asked once: small chains are drawn faster than files are read."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")] if hasattr(os, "sysconf") else []
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            limits.append(int(Path(path).read_text()))
        except (OSError, ValueError):  # no such limit: "max"
            continue
    return min(limits, default=2**63)


def gigabytes(size: float) -> str:
    """Bytes in words."""
    return f"{size / 1e9:.3g} GB"
