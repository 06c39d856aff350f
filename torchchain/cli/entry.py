"""The torchchain command: flags are read before anything heavy is imported, mistakes are one line."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import tyro

from torchchain.cli.flags import COMMANDS

DESCRIPTION = """Wave energy in disordered granular chains: exact ensembles, and the master equation calibrated from them.
A flag overrides the config file, the config file overrides the defaults, which are the paper's case."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        The exit status: 2 for bad input, 1 for a failed computation or a rerun that differs, 130 for an interrupt
        (Ctrl-C), 143 for the signal to end.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        flags = _parse(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    with _one_line_warnings(), _ends() as ends:
        try:
            from torchchain.checks import FieldError, FieldTypeError
            from torchchain.cli import dispatch  # torch and the rest, once the flags are known to be good

            try:
                return dispatch.run(flags, arguments)
            except (FieldError, FieldTypeError) as error:
                return complain(str(error), 2)
            except (RuntimeError, MemoryError) as error:  # a solver that gives up, or no memory left
                return complain(str(error) or type(error).__name__, 1)
        except KeyboardInterrupt as stop:
            status = complain(str(stop) or "interrupted, nothing was written", 143 if ends else 130)
            if any(thread.name.startswith("torchchain") for thread in threading.enumerate()):
                os._exit(status)  # without waiting for the chunks under way, which nobody wants
            return status


@contextlib.contextmanager
def _ends() -> Iterator[list[int]]:
    """The signal to end, as a batch system or torchrun sends it, becomes an interrupt; yields those that came."""
    ends: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield ends
        return

    def end(number: int, _: Any) -> None:
        ends.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield ends
    finally:
        signal.signal(signal.SIGTERM, before)


@contextlib.contextmanager
def _one_line_warnings() -> Iterator[None]:
    before = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"torchchain: warning: {' '.join(str(message).split())}\n"
    try:
        yield
    finally:
        warnings.formatwarning = before


def _parse(arguments: list[str]) -> Any:
    """The flags as a record; a mistake is one line on standard error."""
    caught = io.StringIO()
    try:
        with contextlib.redirect_stderr(caught):
            return tyro.extras.subcommand_cli_from_dict(
                COMMANDS,
                args=arguments,
                prog="torchchain",
                description=DESCRIPTION,
                config=(tyro.conf.CascadeSubcommandArgs,),
            )
    except SystemExit as stop:
        if stop.code:
            complain(one_line(caught.getvalue()), 2)
        raise


def one_line(report: str) -> str:
    """The parser's boxed report as one line: flag, rule, value."""
    lines = [line.strip("│╭╮╰╯─ ").strip() for line in report.splitlines()]
    text = " ".join(line for line in lines if line.strip("-"))
    text = re.sub(r"\s*(For full helptext|Argument helptext|Got errors).*", "", text)
    value = re.search(r"Error parsing (\S+): .*?no type matching (.*?) could be instantiated from \[(.*?)\]", text)
    if value:
        kind = value[2].replace("{None}|", "").strip("{}")
        return f"{value[1]} must be {kind}, got {value[3]}"
    return text


def complain(message: str, status: int) -> int:
    """Print an error as one line on standard error and hand back the exit status."""
    rank = os.environ.get("RANK", "0")
    print(f"torchchain: {f'rank {rank}: ' if rank != '0' else ''}error: {' '.join(message.split())}", file=sys.stderr)
    return status
