"""The history of speeds: what is kept says of what machine it is, and a case that has become slower is named."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "experiments"))

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
