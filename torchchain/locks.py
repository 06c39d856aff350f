"""One run a folder: a lock that ends with the process that holds it, however that ends."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchchain import checks

try:
    import fcntl
except ImportError:  # not a POSIX system: runs do not see each other there
    fcntl = None  # type: ignore[assignment]


@contextmanager
def lock(folder: Path, field: str) -> Iterator[None]:
    """Hold a folder, which need not exist, against other runs by the file ``.NAME.lock`` beside it.

    The operating system frees the lock of a process that has died, so that the next run takes it over. Where a lock
    cannot be written (a folder that is read only, a file system without locks) the run goes on without.

    Raises:
        FieldError: naming the folder and the process that holds it.
    """
    path = Path(folder).absolute()
    path = path.with_name(f".{path.name}.lock")
    made = [parent for parent in path.parents if not os.path.lexists(parent)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        held = _acquired(path, field, folder)
    except checks.FieldError:
        raise
    except (OSError, ValueError):
        held = None
    try:
        yield
    finally:
        if held is not None:
            with suppress(OSError):
                path.unlink()  # before it is let go, so that nobody locks a file that is about to vanish
            os.close(held)
        with suppress(OSError):
            for parent in made:  # a run that wrote nothing leaves nothing
                parent.rmdir()


def _acquired(path: Path, field: str, folder: Path) -> int | None:
    """A descriptor of the locked file, or None where the system has no locks."""
    if fcntl is None:
        return None
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.lexists(path) and os.path.samestat(os.fstat(descriptor), os.stat(path)):
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
                return descriptor
        except BlockingIOError:
            holder = os.read(descriptor, 200).decode(errors="replace") or "another process"
            os.close(descriptor)
            raise checks.FieldError(
                " ".join(f"{field} must be free, got {folder}, where {holder} is running".split())
            ) from None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # its last holder removed the file: once more
