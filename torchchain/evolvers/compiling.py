"""How the kernels are compiled by Numba; importing this file imports Numba.

Numba's cache knows when the file of a kernel has changed, not when that of one it calls has: whoever edits a kernel
touches the files of its callers, too.
"""
# mypy: allow-untyped-defs

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic


def _compiled(*fastmath: str) -> Callable[[Callable], Any]:
    settings: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": set(fastmath)}

    def compile_on_first_call(function: Callable) -> Any:
        try:
            return njit(cache=True, **settings)(function)
        except RuntimeError:  # nowhere to keep what is compiled: then it is compiled in every process
            return njit(**settings)(function)

    return compile_on_first_call


kernel = _compiled("contract")
summing_kernel = _compiled("contract", "reassoc", "nsz")


def _widen(typing_context):
    """Lets LLVM take the widest vectors there are in the function that calls this and in what is inlined there.

    It prefers half of that on processors with 512 bits, as short loops gain nothing; these are long, and gain a
    tenth and more. It is a function's own attribute: other code that Numba compiles is left alone.
    """

    def generate(context, builder, signature, arguments):
        attributes = builder.function.attributes
        if isinstance(attributes, set):  # whose own add, in llvmlite, knows no such pairs
            set.add(attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


wide_vectors: Any = intrinsic(_widen)

# Rows of a scratch are reached as offsets into one flat array, and indices are unsigned: signed ones make Numba
# test for a negative index at every load, which keeps the loops from being vectorized.
U = np.uint64
