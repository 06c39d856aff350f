"""Threads: one for small products, one a chunk of an ensemble."""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from typing import Generic, TypeVar, overload

import torch
from threadpoolctl import ThreadpoolController

Owner = TypeVar("Owner")
Item = TypeVar("Item")
Result = TypeVar("Result")
_waiting: list[threading.Event] = []
"""Works of :func:`meanwhile` that have not been told to begin."""
_waiting_for_core: list[threading.Event] = []
"""The same of :func:`beside`."""


class kept_property(Generic[Owner, Result]):
    """``functools.cached_property`` without its lock: until Python 3.11 objects of one class computed theirs one after the other.

    Two threads that ask for that of one object at the same time may both compute it.
    """

    def __init__(self, compute: Callable[[Owner], Result]) -> None:
        self.compute, self.name = compute, compute.__name__
        self.__doc__ = compute.__doc__

    @overload
    def __get__(self, owner: None, kind: type) -> kept_property[Owner, Result]: ...
    @overload
    def __get__(self, owner: Owner, kind: type) -> Result: ...
    def __get__(self, owner: Owner | None, kind: type) -> kept_property[Owner, Result] | Result:
        if owner is None:
            return self
        value = self.compute(owner)
        owner.__dict__[self.name] = value  # where it is looked for first from now on
        return value


@contextmanager
def single_thread() -> Iterator[int]:
    """Run on one thread, then restore the number, which it gives.

    Products of matrices of some 32 rows gain nothing from more threads, and wait for them where other processes
    hold the cores: 60 times slower was measured beside a busy process.
    """
    before = torch.get_num_threads()
    if before == 1:
        yield before
        return
    torch.set_num_threads(1)
    try:
        yield before
    finally:
        torch.set_num_threads(before)


@contextmanager
def single_blas_thread() -> Iterator[int]:
    """:func:`single_thread` for NumPy and SciPy too."""
    with single_thread() as before, _libraries("scipy.linalg" in sys.modules).limit(limits=1, user_api="blas"):
        yield before


@cache
def _libraries(scipy: bool) -> ThreadpoolController:
    """The libraries that are loaded, with or without SciPy's own; finding them takes some milliseconds."""
    return ThreadpoolController()


@contextmanager
def beside(work: Callable[[], Result], workers: int, at_once: bool = False) -> Iterator[Callable[[], Result]]:
    """Do other work on a thread of one core, at once or as soon as :func:`core_free` is called; gives how to wait for its result.

    It begins when its result is asked for at the latest, and with one worker is done there.
    """
    if workers <= 1:
        yield work
        return
    with _told(work, _waiting_for_core) as (begin, future):

        def result() -> Result:
            begin.set()
            return future.result()

        if at_once:
            begin.set()
        yield result
        begin.set()


def core_free() -> None:
    """Begin what waits for it in :func:`beside`: from here on one thread works where there were several."""
    for begin in _waiting_for_core:
        begin.set()


@contextmanager
def meanwhile(work: Callable[[], object], workers: int) -> Iterator[None]:
    """Do other work on a thread of one core as soon as :func:`map_in_order` has given a first result, while it goes on.

    Until then what it maps needs Python's one lock to begin, and other work would hold it. Not done with one worker, or where
    nothing is mapped.
    """
    if workers <= 1:
        yield
        return
    with _told(work, _waiting):
        yield


@contextmanager
def _told(
    work: Callable[[], Result], waiting: list[threading.Event]
) -> Iterator[tuple[threading.Event, Future[Result]]]:
    """Do other work on a thread of its own once an event is set, which is among those ``waiting`` meanwhile; gives it and the result.

    At the end what has begun is waited for, and what has not is not done, nor is anything waited for of what fails.
    """
    begin, wanted = threading.Event(), True

    def alone() -> Result:
        begin.wait()
        if not wanted:
            raise CancelledError
        return work()

    pool = ThreadPoolExecutor(1, thread_name_prefix="torchchain", initializer=partial(torch.set_num_threads, 1))
    future = pool.submit(alone)
    waiting.append(begin)
    try:
        yield begin, future
        wanted = begin.is_set()
        begin.set()
        pool.shutdown()
    finally:  # of what failed nobody wants the rest
        wanted = False
        begin.set()
        waiting.remove(begin)
        pool.shutdown(wait=False)


def map_in_order(work: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Iterator[Result]:
    """Results of ``work`` in the order of the items, on several threads of one core each.

    Chains are independent: whole chunks side by side need no waiting inside a product, where several threads in one
    small eigen-decomposition mostly wait for each other (40 times slower beside a busy process). At most
    ``workers`` + 1 items are under way or waiting to be taken.
    """
    if workers <= 1:
        for item in items:
            yield work(item)
        return
    before = torch.get_num_threads()

    def alone() -> None:
        torch.set_num_threads(1)

    alone()  # the caller's own products too, while the workers hold the cores
    pool = ThreadPoolExecutor(workers, thread_name_prefix="torchchain", initializer=alone)
    waiting: deque[Future[Result]] = deque()
    wait = True
    try:
        for item in items:
            waiting.append(pool.submit(work, item))
            if len(waiting) > workers:
                yield _first(waiting)
        while waiting:
            yield _first(waiting)
    except (KeyboardInterrupt, GeneratorExit):
        wait = False  # nobody wants what is under way
        raise
    finally:
        pool.shutdown(wait=wait, cancel_futures=True)
        torch.set_num_threads(before)


def _first(waiting: deque[Future[Result]]) -> Result:
    found = waiting.popleft().result()
    for under_way in _waiting:
        under_way.set()
    return found


def ranges(count: int, workers: int) -> list[tuple[int, int]]:
    """Rows 0 to count - 1 as a few ranges (begin, end) for each worker."""
    size = -(-count // (4 * workers if workers > 1 else 1))
    return [(begin, min(begin + size, count)) for begin in range(0, count, size)]


def side_by_side(work: Callable[[int, int], None], count: int) -> None:
    """Runs work(begin, end) over rows 0 to count - 1 side by side, on as many threads as torch uses.

    For work without torch operations, whose number of threads is left alone: setting it, as
    :func:`map_in_order` must, makes later small operations slow beside a busy process.
    """
    workers = min(torch.get_num_threads(), count)
    if workers <= 1:
        work(0, count)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda part: work(*part), ranges(count, workers)))
