"""What the tests share: one thread, one look at the flags' sources, a small ensemble."""

import gc
import os
from functools import cache

if "PYTEST_XDIST_WORKER" in os.environ:  # a process for each core: threads of theirs, and of what they start, would wait for cores
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
import torch
import tyro

import torchchain as tc
from torchchain import cli
from torchchain.cli import entry, outputs

RENDERED = outputs.figure


def pytest_collection_finish():
    """All that was imported stays: garbage is looked for among what tests make alone, and less often."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(cli.GARBAGE)


@pytest.fixture(autouse=True, scope="session")
def one_thread():
    """The matrices are small, and the cores are shared."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True, scope="session")
def one_look_at_sources():
    """For comments beside flags tyro reads the sources of their classes anew in every call: half of its time."""
    with pytest.MonkeyPatch.context() as patch:
        source = tyro._docstrings._ClassTokenization
        patch.setattr(source, "make", staticmethod(cache(source.make)))
        yield


@pytest.fixture(autouse=True, scope="session")
def one_parser():
    """The flags do not change, but tyro makes their parser anew in every call: most of the time of a command that is refused."""
    make, known = tyro._parsers.ParserSpecification.from_callable_or_type, []

    def kept(f, **rest):
        if rest["description"] != entry.DESCRIPTION:  # a part of it
            return make(f, **rest)
        if not known:
            known.append(make(f, **rest))
        return known[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tyro._parsers.ParserSpecification, "from_callable_or_type", staticmethod(kept))
        yield


@pytest.fixture(scope="session")
def small_scene():
    """Twelve rings of 32 particles, four bands, 21 times."""
    return tc.Scene(n_particles=32, n_bands=4, realizations=12, seed=7, times=torch.arange(21, dtype=torch.float64) / 4)


@pytest.fixture(scope="session")
def small_transfer(small_scene):
    """The transfer between its bands, by normal modes."""
    return tc.band_transfer(small_scene, "modes")


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run the command in a folder of its own; returns the exit status, standard output and standard error."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments):
        capsys.readouterr()
        status = cli.main([str(argument) for argument in arguments])
        return status, *capsys.readouterr()

    return command


@pytest.fixture(autouse=True, scope="session")
def figures_unrendered():
    """Figures are made but not rendered, which takes longer than all the rest of a small run, unless ``rendered`` is asked for."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
        yield


@pytest.fixture(scope="module")
def rendered_here():
    """For what a module shares."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outputs, "figure", RENDERED)
        yield


@pytest.fixture
def rendered(monkeypatch):
    """Figures as a user has them."""
    monkeypatch.setattr(outputs, "figure", RENDERED)
