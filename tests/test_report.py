"""report.html: one page of every run, whole in itself, that says what its record says and runs nothing it is told."""

import base64
import json
import re
import warnings
from html.parser import HTMLParser
from pathlib import Path

import pytest

from torchchain import cli
from torchchain.cli import outputs
from torchchain.cli.report import LABELS, page

DUMPS = Path(__file__).parent / "data" / "lammps"
SMALL = ["--n-particles", "32", "--n-bands", "4", "--realizations", "8", "--method", "modes", "--seed", "5"]
CLOSED = {"meta", "img", "br"}


class Page(HTMLParser):
    """Checks that tags close in order, and gathers text, tags and addresses."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags, self.words, self.addresses = [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "data", "action")]
        if tag not in CLOSED:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] != "style":
            self.words.append(data)


def read(out):
    return Page((out / "report.html").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def runs(tmp_path_factory, rendered_here):
    """A small folder of every command that leaves a report."""
    top = tmp_path_factory.mktemp("reports")
    commands = {
        "simulate": ["simulate", *SMALL, "--observables", "center", "band_energy"],
        "calibrate": ["calibrate", *SMALL, "--show", "2,4", "--format", "pdf"],
        "import": [
            "import",
            str(DUMPS / "linear-*.dump.gz"),
            "--reference",
            "{group}.reference.dump",
            "--n-bands",
            "3",
            "--format",
            "pdf",
        ],
        "again": ["calibrate", *SMALL, "--seed", "6"],
        "compare": ["compare", str(top / "calibrate"), str(top / "again")],
        "sweep": ["sweep", "simulate", "disorder.strength=0.1,0.3", "n_particles=16", "n_bands=2", "realizations=4"],
        "predict": ["predict", str(top / "calibrate")],
    }
    for name, words in commands.items():
        assert cli.main([*words, "--out", str(top / name)]) == 0, name
    return top


@pytest.mark.parametrize("command", ["simulate", "calibrate", "import", "compare", "sweep", "predict"])
def test_every_run_leaves_a_whole_page(runs, command):
    out = runs / command
    seen = read(out)
    record = json.loads((out / "run.json").read_text())
    (image,) = seen.addresses  # nothing from outside
    assert base64.b64decode(image.removeprefix("data:image/png;base64,")) == (out / "figure.png").read_bytes()
    assert "script" not in seen.tags
    assert "http" not in (out / "report.html").read_text()
    for title in ("Numbers", "What was asked", "What was done, and why", "Files", "To run it again", "To cite"):
        assert (title in seen.text) is (title != "Numbers" or command != "predict"), title
    assert record["command"] in seen.text
    assert "10.3390/ma14071815" in seen.text
    for reason in record["reasons"]:
        assert " ".join(reason.split()) in seen.text
    for name, value in record.get("summary", {}).items():
        assert LABELS.get(name, name) in seen.text
        if isinstance(value, float):
            assert f"{value:.4g}" in seen.text
    for quantity, value, error in record.get("measured", []):
        assert f"{quantity} {value:.4g}" + ("" if error is None else f" ± {error:.2g}") in seen.text
    assert record["files"]["report.html"] == outputs.sha256(out / "report.html")


def test_what_is_told_of_each(runs):
    assert "center at the last time" in read(runs / "simulate").text
    calibrated = read(runs / "calibrate").text
    assert re.search(r"share of the energy of band 4 still there at t = 50 0\.\d+ ± 0\.\d+", calibrated)
    assert "figure.pdf" in calibrated
    assert (runs / "calibrate" / "figure.pdf").read_bytes().startswith(b"%PDF")
    assert "one band each" in read(runs / "import").text
    assert (runs / "import" / "figure.pdf").read_bytes().startswith(b"%PDF")
    compared = read(runs / "compare").text
    assert "setting one other" in compared
    assert "n values largest difference rms z" in compared  # a table, without what is no number
    assert "nan" not in compared
    assert re.search(r"band_energy at the last time, tone \d+, largest \(band \d\) 0\.\d+ ± 0\.\d+", read(runs / "simulate").text)
    rows = (runs / "sweep" / "sweep.csv").read_text().splitlines()
    assert all(name in read(runs / "sweep").text for name in rows[0].split(","))


def test_nothing_told_becomes_markup(tmp_path):
    evil = "<script>alert('x & \"y\"')</script>"
    record = {
        "arguments": ["simulate"], "command": evil, "out": evil, "title": evil, "reasons": [evil], "warnings": [evil, evil],
        "summary": {evil: evil}, "measured": [(evil, 1.0, None)], "settings": {evil: [evil, evil]}, "seed": evil,
        "versions": {"torchchain": evil}, "started": evil, "seconds": 1.0, "stages": {evil: 1.0}, "machine": evil,
        "device": evil, "working_directory": evil, "resolved": {"method": evil, "options": {evil: evil}},
    }  # fmt: skip
    (tmp_path / "config.toml").write_text(evil)
    (tmp_path / "a.csv").write_text("one,other\n<script>,<b>\n")
    (tmp_path / "<b>").write_text("")
    seen = Page(page(record, tmp_path))
    assert not {"script", "b"} & set(seen.tags)
    assert seen.text.count("alert(") >= 15
    assert seen.text.count("Warning:") == 1  # told twice, said once


def test_warnings_are_shown_and_kept():
    with warnings.catch_warnings(record=True) as shown, outputs.told_warnings() as told:
        warnings.simplefilter("always")
        warnings.warn("first\n line", UserWarning, stacklevel=1)
    assert told == ["first line"]
    assert len(shown) <= 1
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        warnings.warn("second", UserWarning, stacklevel=1)
    assert told == ["first line"]
    assert len(shown) == 1


def test_a_run_that_warns_says_so(tmp_path):
    words = ["simulate", *SMALL, "--excitation.amplitude", "0.3", "--out", str(tmp_path / "out")]
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        assert cli.main(words) == 0
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["warnings"]
    assert all(
        f"Warning: {line}" in read(tmp_path / "out").text for line in map(" ".join, map(str.split, record["warnings"]))
    )
