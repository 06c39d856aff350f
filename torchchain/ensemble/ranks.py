"""Many processes: the realizations of an ensemble divided among the ranks of torch.distributed, as torchrun starts them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from torchchain.ensemble.statistics import EnsembleMoments

_LAUNCHED = {"RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"}
_HOST = torch.device("cpu")
# A rank waits in the last step for the slowest; one that dies closes its connections, which ends the wait at once.
_PATIENCE = timedelta(days=7)


@dataclass(frozen=True)
class Ranks:
    """This process among those that share an ensemble; alone by default.

    What passes between ranks are settings at the start and reduced moments at the end, on the CPU.

    Attributes:
        rank: number of this process, from 0.
        size: number of processes.

    Example:
        >>> [list(tc.ensemble.Ranks(rank, 2).part([range(10)])[0]) for rank in (0, 1)]
        [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9]]
    """

    rank: int = 0
    size: int = 1

    def agree(self, value: Any) -> Any:
        """The value that rank 0 holds, on every rank."""
        if self.size == 1:
            return value
        held = [value]
        with _connected():
            dist.broadcast_object_list(held, src=0, device=_HOST)
        return held[0]

    def part(self, ranges: Sequence[range], multiple: int = 1) -> list[range]:
        """This rank's part of the realizations: neighbors, whose moments merge to a few nodes.

        Args:
            ranges: realizations to be divided, in order.
            multiple: cuts are made at realization numbers that it divides.
        """
        low, high = (self._cut(ranges, rank, multiple) for rank in (self.rank, self.rank + 1))
        parts = (range(max(r.start, low), min(r.stop, high)) for r in ranges)
        return [part for part in parts if len(part)]

    def _cut(self, ranges: Sequence[range], rank: int, multiple: int) -> int:
        """The first realization of a rank's part."""
        left = sum(map(len, ranges)) * rank // self.size
        for part in ranges:
            if left < len(part):
                return (part.start + left) // multiple * multiple
            left -= len(part)
        return ranges[-1].stop if ranges else 0

    def total(self, moments: EnsembleMoments) -> EnsembleMoments:
        """The moments of all ranks on rank 0, in log2(size) steps; those of the other ranks are used up.

        Neighbors meet first, and the moments' merging order depends on realization numbers alone: the total is
        bitwise the same for any number of ranks.
        """
        step = 1
        with _connected():
            while step < self.size:
                if self.rank % (2 * step):
                    plain = moments.tensors()
                    dist.send_object_list([_outline(plain)], dst=self.rank - step, device=_HOST)
                    for values in plain.values():
                        dist.send(values, dst=self.rank - step)
                    break
                if self.rank + step < self.size:
                    held: list[Any] = [None]
                    dist.recv_object_list(held, src=self.rank + step, device=_HOST)
                    plain = _room(held[0])
                    for values in plain.values():
                        dist.recv(values, src=self.rank + step)
                    moments.absorb(moments.again(plain))
                step *= 2
        return moments

    def everywhere(self, moments: EnsembleMoments) -> EnsembleMoments:
        """Rank 0's moments on every rank."""
        if self.size == 1:
            return moments
        plain = moments.tensors() if self.rank == 0 else {}
        outline = self.agree(_outline(plain))
        plain = plain or _room(outline)
        with _connected():
            for values in plain.values():
                dist.broadcast(values, src=0)
        return moments if self.rank == 0 else moments.again(plain)


ALONE = Ranks()


@contextmanager
def process_group(device: str | torch.device = "cpu") -> Iterator[Ranks]:
    """The ranks of this run: those of the process group at hand, or of the one that torchrun's environment describes.

    Without either, this process is alone. The group is gloo on the CPU, gloo and nccl beside GPUs.
    """
    if dist.is_available() and dist.is_initialized():
        yield Ranks(dist.get_rank(), dist.get_world_size())
        return
    if not launched():
        yield ALONE
        return
    cuda = torch.device(device).type == "cuda"
    store, rank, size = next(dist.rendezvous("env://", timeout=_PATIENCE))
    if os.environ.get("GROUP_WORLD_SIZE") == "1":
        # torchrun's store outlives a restart: a process would meet the addresses of those that died. Machines count
        # restarts each for itself, so that several need TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 in its place.
        store = dist.PrefixStore(f"restart {os.environ.get('TORCHELASTIC_RESTART_COUNT', 0)}", store)
    backend = "cpu:gloo,cuda:nccl" if cuda else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=_PATIENCE)
    try:
        yield Ranks(dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()


def launched() -> bool:
    """Whether torchrun, or something that sets its variables, started this process as one of several."""
    return os.environ.keys() >= _LAUNCHED and int(os.environ["WORLD_SIZE"]) > 1


def rank_of_environment() -> int:
    """The rank that torchrun gave to this process; 0 without it."""
    return int(os.environ["RANK"]) if launched() else 0


def own_device(device: str) -> str:
    """The device of this process: for "cuda", the GPU of its number on the machine."""
    if device != "cuda" or not launched():
        return device
    return f"cuda:{int(os.environ.get('LOCAL_RANK', 0)) % max(1, torch.cuda.device_count())}"


def fair_threads() -> int:
    """Threads of a process beside its neighbors on this machine: its share of the cores that they may use.

    torchrun sets one thread a process, whatever the number of cores.
    """
    neighbors = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    if not launched() or neighbors < 1:
        return torch.get_num_threads()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // neighbors)


@contextmanager
def _connected() -> Iterator[None]:
    """A lost connection in one line: what the library says of it names addresses alone."""
    try:
        yield
    except RuntimeError as error:
        raise RuntimeError("another process of this run has ended or cannot be reached") from error


def _outline(plain: Mapping[str, Tensor]) -> list[tuple[str, torch.Size, torch.dtype]]:
    """What is to be known of tensors before they pass: as such, as pickling them would take far longer."""
    return [(name, values.shape, values.dtype) for name, values in plain.items()]


def _room(outline: list[tuple[str, torch.Size, torch.dtype]]) -> dict[str, Tensor]:
    """Tensors to be filled."""
    return {name: torch.empty(shape, dtype=dtype) for name, shape, dtype in outline}
