"""What README and pages say can be followed: links lead somewhere, code runs, words of commands are flags."""

import re
import shutil
from pathlib import Path

import pytest

import torchchain as tc
from torchchain.cli import flags

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "howto").glob("*.md"))]


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8")):
        if "://" not in target and not target.startswith("_generated/") and "/_generated/" not in target:
            assert (page.parent / target).exists(), target


def test_code_of_the_readme_runs(tmp_path, monkeypatch):
    ten, own = blocks(ROOT / "README.md", "python")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(ten, names)
    assert names["energy"].shape == (501, 32)
    assert float((names["energy"].sum(-1) - 1).abs().max()) < 1e-9
    assert tc.MasterEquation.load("model.safetensors").n_bands == 32
    shutil.copytree(ROOT / "tests" / "data" / "lammps", tmp_path / "tests" / "data" / "lammps")
    exec(own, names)
    assert names["transfer"].n_bands == 3
    assert len([line for line in own.splitlines() if line]) == 6


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_have_their_flags(page):
    for text in blocks(page, "bash"):
        for line in text.replace("\\\n", " ").splitlines():
            found = re.search(r"torchchain (\w+)(.*?)(?:#|$)", line)
            if not found or found[1] not in flags.COMMANDS or "srun" in line:
                continue
            known = flags.names(flags.COMMANDS[found[1]])
            for flag in re.findall(r"(--[\w.-]+)", found[2]):
                assert flag in known, line


def test_readme_tells_every_word_where_it_first_appears():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    for word, meaning in (
        ("bands", "wavelength"),
        ("source", "starts in one"),
        ("ξ", "masses vary"),
        ("total variation", "wrong band"),
    ):
        place = text.find(word)
        assert place > -1
        assert meaning in text[max(0, place - 200) : place + 300], word


def test_every_experiment_has_its_figure_and_numbers_in_the_gallery():
    kept = {path.name for path in (ROOT / "docs" / "gallery").iterdir()}
    hidden = re.search(r"^HIDDEN = \((.*)\)$", (ROOT / "docs" / "_ext" / "pages.py").read_text(encoding="utf-8"), re.M)[1]
    for path in (ROOT / "experiments").glob("*.py"):
        if f'"{path.stem}"' not in hidden:
            assert {f"{path.stem}.png", f"{path.stem}.txt"} <= kept, path.stem
