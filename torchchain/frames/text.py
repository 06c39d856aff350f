"""Text files, plain or gzip, read in blocks: bounded memory whatever the file announces."""

from __future__ import annotations

import csv
import gzip
import io
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from torchchain import checks

CHUNK = 1 << 22
LONGEST_LINE = 1 << 16
SMALL = 1 << 16
"""Bytes of rows below which they are split here, not by the parser."""
BLANKS = np.frombuffer(b" \t\n\r\x0b\x0c", dtype=np.uint8)
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


def as_number(field: str, word: str, whole: bool = False) -> float:
    """A word of a file as a finite number."""
    try:
        if "_" in word:
            raise ValueError
        value = int(word) if whole else float(word)
        good = abs(value) < 2**63 and np.isfinite(float(value))
    except ValueError:
        good = False
    if not good:
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
    import pandas

    parts: dict[str, list[np.ndarray]] = {name: [] for name in columns if name in wanted}
    kinds = {i: np.int64 if name in integers else np.float64 for i, name in enumerate(columns) if name in wanted}
    last, done = len(columns) - 1, 0
    for block in blocks:
        rows = block.count(b"\n")
        plain = _plain(block, rows, last + 1, kinds) if len(block) < SMALL else None
        if plain is not None:
            for i, values in plain.items():
                parts[columns[i]].append(values)
            done += rows
            continue
        try:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "error", pandas.errors.ParserWarning
                )  # all that it says of rows that are too long
                table = pandas.read_csv(
                    io.BytesIO(block), sep=r"\s+", header=None, names=range(last + 1), dtype=kinds, na_filter=False,
                    quoting=csv.QUOTE_NONE, index_col=False, encoding="latin-1", skip_blank_lines=False, low_memory=False,
                )  # fmt: skip
            # A row that is too short ends in an empty word.
            good = len(table) == rows and (
                last in kinds or table[last].dtype.kind in "iuf" or not (table[last] == "").any()
            )
            good = good and all(np.isfinite(table[i].to_numpy()).all() for i in kinds)
        except (ValueError, OverflowError, pandas.errors.ParserWarning):
            good = False
        if not good:
            raise _first_bad(where, block, columns, integers, wanted, done)
        for i in kinds:
            parts[columns[i]].append(table[i].to_numpy(copy=True))
        done += rows
    for i, kind in kinds.items():
        if not parts[columns[i]]:
            parts[columns[i]].append(np.empty(0, dtype=kind))
    return {name: part[0] if len(part) == 1 else np.concatenate(part) for name, part in parts.items()}


def _plain(block: bytes, rows: int, width: int, kinds: Mapping[int, type]) -> dict[int, np.ndarray] | None:
    """The wanted columns of a few good rows, for which starting a parser takes longer than parsing; None for others."""
    words = block.split()
    # Where a word begins and a line ends: as many words in every line.
    text = np.frombuffer(block, dtype=np.uint8)
    blank = np.isin(text, BLANKS)
    begins = np.flatnonzero(~blank & np.concatenate(([True], blank[:-1])))
    counts = np.diff(np.searchsorted(begins, np.flatnonzero(text == 10)), prepend=0)
    if len(words) != rows * width or len(begins) != len(words) or (counts != width).any() or b"_" in block:
        return None
    table = np.array(words).reshape(rows, width)
    try:
        found: dict[int, np.ndarray] = {i: table[:, i].astype(kind) for i, kind in kinds.items()}
    except (ValueError, OverflowError):
        return None
    return found if all(np.isfinite(values).all() for values in found.values()) else None


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
            if name not in wanted:
                continue
            try:
                value = int(word) if name in integers else float(word)
                good = "_" not in word and (abs(value) < 2**63 if name in integers else np.isfinite(value))
            except ValueError:
                good = False
            if not good:
                kind = "a whole number" if name in integers else "a finite number"
                return checks.fail(f"{where}: {name}", f"be {kind}", f"{checks.shown(word, 40)} in row {done + i + 1}")
    return checks.fail(f"{where}: rows", "be numbers with blanks between", checks.shown(block[:40].decode("latin-1")))
