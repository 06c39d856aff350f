"""The reference: every public name has its topic and an example, and every example gives what it says."""

import doctest
import importlib
import inspect
import sys
import warnings
from pathlib import Path

import pytest
import torch

import torchchain as tc

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs" / "_ext"))
import api_pages

NAMES = {
    name: value
    for name, value in api_pages.public_names().items()
    if inspect.isclass(value) or inspect.isfunction(value)
}


def examples(name):
    """The docstring's examples and those of the methods."""
    value = NAMES[name]
    names = {**vars(importlib.import_module(value.__module__)), "tc": tc, "torch": torch}
    return [test for test in doctest.DocTestFinder(exclude_empty=True).find(value, name, globs=names) if test.examples]


@pytest.fixture
def registries():
    """Names that an example registers are gone after it."""
    kept = [(registry, dict(registry)) for registry in (tc.METHODS, tc.MODELS, tc.OBSERVABLES)]
    yield
    for registry, before in kept:
        registry.clear()
        registry.update(before)


def test_every_public_name_has_a_topic():
    assert api_pages.by_topic()[""] == []


@pytest.mark.parametrize("name", NAMES)
def test_examples(name, registries):
    found = examples(name)
    assert any(test.name == name for test in found), f"the docstring of {name} has no example"
    said: list[str] = []
    for test in found:
        runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE, verbose=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            runner.run(test, out=said.append)
    assert not said, "".join(said)
