"""The command line: flags in, a folder out."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading

TYPE_CHECKING = False
if TYPE_CHECKING:  # nothing that takes time before signals are heard
    from collections.abc import Sequence
    from typing import Any

__all__ = ["main"]

GARBAGE = 100_000
"""Objects made between two searches for circular garbage: Python's 700 cost a tenth of the imports and of a figure."""
INTERRUPTED = "torchchain: error: interrupted, nothing was written\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; without arguments as a program of its own, which also owns signals, streams and warnings.

    Returns:
        The exit status: 2 for bad input, 1 for a failed computation or a rerun that differs, 130 for an interrupt
        (Ctrl-C), 143 for the signal to end, 141 where nobody reads the output any more.
    """
    if arguments is not None:
        from torchchain.cli.entry import command

        return command(list(arguments))
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _at_once)  # a KeyboardInterrupt amid imports would be a traceback
    gc.set_threshold(GARBAGE)
    try:
        from torchchain.cli.entry import program

        status = program(sys.argv[1:])
        sys.stdout.flush()
        gc.freeze()  # or Python looks through all that was imported once more before it ends, for most of a second
        return status
    except BrokenPipeError:  # "| head -1": what was to be written is written
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        return 141


def _at_once(number: int, frame: Any) -> None:
    """End before anything has begun, with one line and no traceback."""
    os.write(2, INTERRUPTED.encode())
    os._exit(128 + number)
