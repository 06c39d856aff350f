"""The history of speeds: what is kept says of what machine it is, and a case that has become slower is named."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "experiments"))

import speed_against
import speed_history

SMALL = ["--size", "0", "--repeats", "1"]


def test_kept_files_hold_the_machine_and_are_compared(tmp_path, capsys, monkeypatch):
    def a_second(run):
        run()
        return 1.0

    monkeypatch.setattr(speed_history, "timed", a_second)
    words = [*SMALL, "--folder", str(tmp_path)]
    assert speed_history.main([*words, "--keep"]) == 0
    (kept,) = tmp_path.glob("speed_*.json")
    data = json.loads(kept.read_text())
    assert {"processor", "cores", "python", "torch", "torchchain"} <= data["machine"].keys()
    assert len(data["cases"]) >= 12
    assert all(row["ratio"] == 1.0 for row in data["cases"].values())
    assert kept.stat().st_size < 4000
    first, second, *others = data["cases"]
    data["cases"] = {first: {"seconds": 1.0, "ratio": 0.5}, second: {"seconds": 1.0, "ratio": 0.9}}
    data["machine"]["processor"] = "an abacus"
    kept.write_text(json.dumps(data))
    monkeypatch.setattr(speed_history, "timed", lambda run: 1.0)  # they have run
    capsys.readouterr()
    assert speed_history.main(words) == 1
    lines = {line.split("  ")[0].strip(): line for line in capsys.readouterr().out.splitlines()}
    assert lines[first].endswith("2.00 SLOWER")
    assert lines[second].endswith("1.11")
    assert all("SLOWER" not in lines[name] for name in others)
    assert any("an abacus" in line for line in lines.values())
    assert len(list(tmp_path.iterdir())) == 1  # nothing kept that was not asked for


def test_the_last_file_is_that_measured_last(tmp_path):
    assert speed_history.last(tmp_path, 1) is None
    for name, measured, size in (("a", "2026-01-02", 1), ("b", "2026-01-01", 1), ("c", "2026-01-03", 0)):
        (tmp_path / f"speed_{name}.json").write_text(json.dumps({"measured": measured, "size": size}))
    assert speed_history.last(tmp_path, 1)[0] == "speed_a.json"


@pytest.mark.parametrize("path", sorted((speed_history.ROOT / "charts").glob("*.json")), ids=lambda path: path.name)
def test_files_of_the_project_are_of_this_kind(path):
    data = json.loads(path.read_text())
    assert data["size"] == 1
    assert all(row["seconds"] > 0 and row["ratio"] > 0 for row in data["cases"].values())
    assert data["machine"]["torchchain"] in path.name


@pytest.mark.parametrize("name", [name for name, _ in speed_against.cases(0)])
def test_cases_that_two_versions_are_compared_by_run(name):
    dict(speed_against.cases(0))[name]()()


def test_two_versions_are_timed_in_turn_and_reported(tmp_path, capsys):
    root = speed_history.ROOT.parent
    words = [str(root), *SMALL, "--only", "kinetic energy, ring", "count of modes", "--out", str(tmp_path)]
    speed_against.main(words)  # of a version against itself the status is chance
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[1:3]] == ["kinetic energy, ring", "count of modes"]
    assert all(float(number) > 0 for line in lines[1:3] for number in line.removesuffix(" SLOWER").split()[-3:])
    assert (tmp_path / "report.txt").read_text().splitlines() == lines


def test_a_version_without_what_is_asked_says_so(tmp_path, capsys):
    (tmp_path / "torchchain.py").write_text("raise ImportError('an empty shell')")
    speed_against.main([str(tmp_path), *SMALL, "--only", "kinetic energy, ring", "--out", str(tmp_path)])
    assert "the process ended" in capsys.readouterr().out
