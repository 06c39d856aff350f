"""The torchchain command: flags are read before anything heavy is imported, mistakes are one line."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from typing import Any

import tyro

from torchchain._version import __version__
from torchchain.cli import flags as known
from torchchain.cli.mistakes import one_line

DESCRIPTION = """Wave energy in disordered granular chains: exact ensembles, and the master equation calibrated from them.
A flag overrides the config file, the config file overrides the defaults, which are the paper's case.
torchchain COMMAND --help lists the flags of a command, torchchain --version says which version this is."""


def program(arguments: list[str]) -> int:
    """The command as a process of its own: warnings, turned into errors or not, are lines and cost no result."""
    warnings.resetwarnings()
    warnings.simplefilter("ignore")
    warnings.simplefilter("default", UserWarning)
    warnings.simplefilter("default", RuntimeWarning)
    status = command(arguments, signals=True)
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # nothing is left to save
    return status


def command(arguments: list[str], signals: bool = False) -> int:
    """Run one command; returns the exit status."""
    if arguments == ["--version"]:
        print(f"torchchain {__version__}")
        return 0
    try:
        flags = _parse(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    with _lines(), _ends() as ends:
        try:
            logging.getLogger("torchchain").info("loading")
            from torchchain.checks import FieldError, FieldTypeError
            from torchchain.cli import dispatch  # torch and the rest, once the flags are known to be good

            if signals and threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGINT, signal.default_int_handler)
            try:
                return dispatch.run(flags, arguments)
            except (FieldError, FieldTypeError) as error:
                return complain(str(error), 2)
            except BrokenPipeError:
                raise
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


class _Notices(logging.Handler):
    """Notices of the library as lines on standard error; those that only say what goes on where a person looks on."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno >= logging.WARNING or sys.stderr.isatty():
            with contextlib.suppress(OSError, ValueError):  # nobody reads them any more
                print(f"torchchain: {record.getMessage()}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def _lines() -> Iterator[None]:
    """Warnings and notices are one line each until this ends."""
    log, handler = logging.getLogger("torchchain"), _Notices()
    before = warnings.formatwarning, log.level, log.propagate
    warnings.formatwarning = lambda message, *_, **__: f"torchchain: warning: {' '.join(str(message).split())}\n"
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        warnings.formatwarning, log.level, log.propagate = before


def _parse(arguments: list[str]) -> Any:
    """The flags as a record; a mistake is one line on standard error."""
    caught = io.StringIO()
    try:
        with contextlib.redirect_stderr(caught):
            return tyro.extras.subcommand_cli_from_dict(
                known.COMMANDS,
                args=arguments,
                prog="torchchain",
                description=DESCRIPTION,
                config=(tyro.conf.CascadeSubcommandArgs,),
            )
    except SystemExit as stop:
        if stop.code:
            complain(one_line(caught.getvalue(), arguments), 2)
        raise


def complain(message: str, status: int) -> int:
    """Print an error as one line on standard error and hand back the exit status."""
    rank = os.environ.get("RANK", "0")
    print(f"torchchain: {f'rank {rank}: ' if rank != '0' else ''}error: {' '.join(message.split())}", file=sys.stderr)
    return status
