"""One version everywhere, one list of dependencies, and a changelog that tells of it."""

import re
import tomllib
from pathlib import Path

import pytest

import torchchain as tc

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
CONDA = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
"""Names that differ there."""


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def test_citation_and_changelog_tell_of_this_version():
    assert re.search(r"^version: (.+)$", text("CITATION.cff"), re.M)[1] == tc.__version__
    newest = re.search(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", text("CHANGELOG.md"), re.M)
    assert newest[1] == tc.__version__
    assert re.search(r"^date-released: (.+)$", text("CITATION.cff"), re.M)[1] == newest[2]


def test_conda_recipe_has_the_dependencies_of_the_package():
    assert re.search(r'^  version: "(.+)"$', text("recipe/recipe.yaml"), re.M)[1] == tc.__version__
    run = text("recipe/recipe.yaml").partition("  run:\n")[2].partition("\n\n")[0]
    recipe = set(re.findall(r"^    - (\S+) >=(\S+)$", run, re.M))
    wanted = {tuple(requirement.split(">=")) for requirement in PROJECT["dependencies"]}
    assert recipe == {("python", PROJECT["requires-python"].removeprefix(">="))} | {
        (CONDA.get(name, name), version) for name, version in wanted
    }


def test_pinned_versions_are_not_below_the_lowest():
    def numbers(version):
        return [int(part) for part in re.findall(r"\d+", version)]

    pinned = {
        name.lower().replace("_", "-"): version
        for name, version in re.findall(r"^(\S+)==(\S+)$", text("constraints.txt"), re.M)
    }
    for requirement in PROJECT["dependencies"]:
        name, version = requirement.split(">=")
        assert numbers(pinned[name.lower()]) >= numbers(version), requirement


def test_lowest_versions_as_pins():
    pins = re.findall(r"^[^#\s]+$", text("constraints-lowest.txt"), re.M)
    extras = PROJECT["optional-dependencies"]
    assert pins == [r.replace(">=", "==") for r in PROJECT["dependencies"] + extras["test"] + extras["xyz"]]


@pytest.mark.parametrize("name", ["tests", "docs"])
def test_workflows_run_what_the_project_runs(name):
    workflow = text(f".github/workflows/{name}.yml")
    wanted = {
        "tests": ["python -m pytest -n auto", ".ci/release.sh", "-c constraints-lowest.txt", *(f'"3.{minor}"' for minor in (11, 12, 13))],
        "docs": ["sphinx-build -W"],
    }[name]
    assert all(word in workflow for word in wanted)
    for minor in re.findall(r"Python :: 3\.(\d+)", " ".join(PROJECT["classifiers"])):
        assert name == "docs" or f'"3.{minor}"' in workflow
