"""Text files, plain or gzip, read in blocks: bounded memory whatever the file announces."""

from __future__ import annotations

import gzip
import io
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from torchchain import checks

CHUNK = 1 << 22  # bytes read at a time
LONGEST_LINE = 1 << 16  # bytes
T = TypeVar("T")
GZIP_RATIO = 1032  # deflate cannot make more bytes than this of one


class CutShort(Exception):
    """The file ends, or a gzip stream breaks off, in the middle of something."""

    def __init__(self, rows: int = 0) -> None:
        super().__init__()
        self.rows = rows


def readable(field: str, path: Path) -> Path:
    """The path, if it is a file with something in it that can be opened."""
    try:
        if not path.is_file():
            raise checks.fail(
                field, "be a file that can be read", f"{path} ({'no file' if path.exists() else 'nothing there'})"
            )
        with open(path, "rb") as file:
            empty = not file.read(1)
    except (OSError, ValueError) as error:  # ValueError: a zero byte in the name, and FieldError
        if isinstance(error, checks.FieldError):
            raise
        raise checks.fail(
            field, "be a file that can be read", f"{str(path)!r} ({getattr(error, 'strerror', None) or error})"
        ) from None
    if empty:
        raise checks.fail(field, "hold at least one frame", f"{path.name} of 0 bytes")
    return path


class Text:
    """A text file as lines and as blocks of rows, from a byte position on."""

    def __init__(self, path: Path, position: int = 0) -> None:
        self.path = path
        self.name = path.name
        with open(path, "rb") as file:
            self.compressed = file.read(2) == b"\x1f\x8b"
        self._file: Any = gzip.open(path, "rb") if self.compressed else open(path, "rb")  # noqa: SIM115
        self._buffer, self._start, self._ended = b"", 0, False
        self._broken = False
        self.position = 0
        if position:
            self.seek(position)

    def __enter__(self) -> Text:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def seek(self, position: int) -> None:
        """Go to a byte of the uncompressed text."""
        if position != self.position:
            self._guard(lambda: self._file.seek(position))
            self._buffer, self._start, self._ended, self._broken, self.position = b"", 0, False, False, position

    def head(self, size: int) -> bytes:
        """The first bytes of the text, as many as there are if a gzip stream breaks off."""
        try:
            self._fill()
        except CutShort:
            return b""
        return self._buffer[:size]

    def room_for(self, rows: int, columns: int) -> bool:
        """Whether the file is large enough to hold that many rows, at two bytes a number."""
        size = self.path.stat().st_size * (GZIP_RATIO if self.compressed else 1)
        return 2 * rows * columns <= size

    def _guard(self, read: Callable[[], T]) -> T:
        try:
            return read()
        except EOFError:
            raise CutShort from None
        except (OSError, zlib.error) as error:
            raise checks.fail(f"{self.name}", "be whole and readable", f"{error} after byte {self.position}") from None

    def _fill(self) -> bool:
        """Read on; False at the end of the file."""
        if self._ended:
            return False
        more = self._guard(self._read)
        if not more:
            self._ended = True
            return False
        self._buffer = self._buffer[self._start :] + more
        self._start = 0
        return True

    def _read(self) -> bytes:
        """About a chunk; of a gzip stream that breaks off first all that there is, then the error."""
        if not self.compressed:
            return bytes(self._file.read(CHUNK))
        parts, size = [], 0
        while size < CHUNK and not self._broken:
            try:
                part = self._file.read1(CHUNK - size)
            except EOFError:
                self._broken = True
                break
            if not part:
                break
            parts.append(part)
            size += len(part)
        if self._broken and not parts:
            raise EOFError
        return b"".join(parts)

    def line(self) -> str | None:
        """The next line without its end, or None at the end of the file. A last line without an end is cut short."""
        while True:
            end = self._buffer.find(b"\n", self._start)
            if end >= 0:
                break
            self._limit(len(self._buffer) - self._start)
            if not self._fill():
                if self._start < len(self._buffer):
                    raise CutShort
                return None
        found = self._buffer[self._start : end]
        self._limit(len(found))
        self.position += end + 1 - self._start
        self._start = end + 1
        return found.decode("latin-1").strip()

    def _limit(self, length: int) -> None:
        if length > LONGEST_LINE:
            raise checks.fail(
                self.name,
                f"be text with lines of at most {LONGEST_LINE} bytes",
                f"a longer one at byte {self.position}",
            )

    def blocks(self, rows: int) -> Iterator[bytes]:
        """The next ``rows`` lines, in blocks of whole lines."""
        done = 0
        while done < rows:
            # A window of about the size needed: small frames must not copy the whole buffer each time.
            view = self._buffer[self._start : self._start + max(1 << 12, 128 * (rows - done))]
            found = view.count(b"\n")
            if not found and self._start + len(view) < len(self._buffer):
                view = self._buffer[self._start :]
                found = view.count(b"\n")
            if done + found >= rows:
                ends = np.flatnonzero(np.frombuffer(view, dtype=np.uint8) == 10)
                end = int(ends[rows - done - 1]) + 1
                found = rows - done
            else:
                end = view.rfind(b"\n") + 1
                self._limit(len(view) - end)
            if found:
                yield view[:end]
                done += found
                self._start += end
                self.position += end
            else:
                with suppress(CutShort):  # of damaged bytes: so many rows are whole
                    if self._fill():
                        continue
                raise CutShort(done)

    def count_until(self, mark: bytes) -> int:
        """Pass over the lines before the next one that begins with ``mark``, or before the end; how many they are."""
        done = 0
        while True:
            start = self._start
            here = self._buffer.startswith(mark, start)
            end = start if here else self._buffer.find(b"\n" + mark, start) + 1
            found = here or end > 0
            end = end if found else self._buffer.rfind(b"\n", start) + 1
            end = max(end, start)
            done += self._buffer.count(b"\n", start, end)
            self._start = end
            self.position += end - start
            if found:
                return done
            self._limit(len(self._buffer) - end)
            if not self._fill():
                if self._start < len(self._buffer):
                    raise CutShort(done)
                return done

    def skip(self, rows: int, mark: bytes) -> int:
        """Pass over rows; how many came before a line that begins with ``mark``, all if none does."""
        done = 0
        for block in self.blocks(rows):
            at = 0 if block.startswith(mark) else block.find(b"\n" + mark) + 1
            if at or block.startswith(mark):
                return done + block.count(b"\n", 0, at)
            done += block.count(b"\n")
        return done


def number_of(word: str, whole: bool = False) -> float | None:
    """The finite number that a word of a file is, None if it is none."""
    try:
        value = int(word) if whole else float(word)
    except ValueError:
        return None
    return value if "_" not in word and (abs(value) < 2**63 if whole else np.isfinite(value)) else None


def as_number(field: str, word: str, whole: bool = False) -> float:
    """The same, below 2^63; an error for what is none."""
    value = number_of(word, whole)
    if value is None or abs(value) >= 2**63:
        raise checks.fail(field, f"be a {'whole' if whole else 'finite'} number", checks.shown(word, 40))
    return value


def parse(
    where: str, blocks: Iterator[bytes], columns: Sequence[str], integers: set[str], wanted: set[str]
) -> dict[str, np.ndarray]:
    """Rows of numbers as one array a column.

    Args:
        where: file and frame, for errors.
        blocks: whole lines.
        columns: names of all columns in a row.
        integers: which of them are whole numbers.
        wanted: which of them are returned.

    Raises:
        FieldError: for a row with more or fewer columns, or a value that is no finite number, naming row and column.
    """
    kinds = {name: np.int64 if name in integers else np.float64 for name in columns if name in wanted}
    # Words that nobody wants take a byte each: rows must hold as many words as there are columns.
    row = np.dtype([(name, kinds.get(name, "S1")) for name in columns])
    parts, done = [np.empty(0, row)], 0
    for block in blocks:
        rows = block.count(b"\n")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # of blocks without words, or an integer that is written like 1.0
                table = np.loadtxt(io.BytesIO(block), row, comments=None, ndmin=1, encoding="latin-1")
            good = len(table) == rows and all(np.isfinite(table[name]).all() for name in kinds)
        except (ValueError, UserWarning, DeprecationWarning):
            good = False
        if not good:
            raise _first_bad(where, block, columns, integers, wanted, done)
        parts.append(table)
        done += rows
    return {name: np.concatenate([part[name] for part in parts]) for name in kinds}


def _first_bad(
    where: str, block: bytes, columns: Sequence[str], integers: set[str], wanted: set[str], done: int
) -> checks.FieldError:
    """The error for the first row of a block that is not as it should be."""
    for i, row in enumerate(block.decode("latin-1").split("\n")[:-1]):
        words = row.split()
        if len(words) != len(columns):
            return checks.fail(
                f"{where}: row {done + i + 1}",
                f"hold {len(columns)} columns ({checks.shown(' '.join(columns), 60)})",
                f"{len(words)}: {checks.shown(row, 50)}",
            )
        for name, word in zip(columns, words, strict=True):
            if name in wanted and number_of(word, name in integers) is None:
                kind = "a whole number" if name in integers else "a finite number"
                return checks.fail(f"{where}: {name}", f"be {kind}", f"{checks.shown(word, 40)} in row {done + i + 1}")
    return checks.fail(f"{where}: rows", "be numbers with blanks between", checks.shown(block[:40].decode("latin-1")))
