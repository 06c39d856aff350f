"""The memory that a call takes, counted: the same on every machine, however busy it is."""

import tracemalloc

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

LITTLE = 100e6
"""Bytes that a refusal may take."""


class Taken(TorchDispatchMode):
    """Bytes of the largest tensor that is made, and of what NumPy and Python hold at most."""

    def __enter__(self):
        self.largest = 0
        tracemalloc.start()
        return super().__enter__()

    def __exit__(self, *error):
        super().__exit__(*error)
        self.largest = max(self.largest, tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        made = (value.untyped_storage().nbytes() for value in tree_leaves(result) if isinstance(value, torch.Tensor))
        self.largest = max(self.largest, *made, 0)
        return result
