"""The notebooks run from top to bottom, say what their words say, and were saved with what they print and draw."""

import contextlib
import json
import os
import runpy
from pathlib import Path

import numpy as np
import pytest

import torchchain as tc

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"
RUN = runpy.run_path(str(FOLDER / "run.py"))


@pytest.fixture
def executed(monkeypatch):
    """Runs a notebook: its names, and what it printed; what it registers is gone after the test."""
    monkeypatch.setenv("MPLBACKEND", "agg")
    kept = [(registry, dict(registry)) for registry in (tc.METHODS, tc.MODELS, tc.OBSERVABLES)]
    before = os.listdir(FOLDER)

    def execute(name):
        names, outputs = RUN["execute"](FOLDER / f"{name}.ipynb")
        cells = [c for c in json.loads((FOLDER / f"{name}.ipynb").read_text())["cells"] if c["cell_type"] == "code"]
        for cell, found in zip(cells, outputs, strict=True):
            assert [o["output_type"] for o in cell["outputs"]] == [o["output_type"] for o in found], cell["source"]
        return names, "".join("".join(o.get("text", [])) for found in outputs for o in found)

    yield execute
    assert os.listdir(FOLDER) == before
    for registry, entries in kept:
        registry.clear()
        registry.update(entries)


def test_the_paper_in_ten_minutes(executed):
    names, _ = executed("1_paper_in_ten_minutes")
    q = names["q"]
    for source, receiver, paper, digit in ((23, 23, -0.18, 0.01), (20, 20, -0.161, 0.001), (23, 20, 0.0079, 1e-4)):
        pair = q.sel(source=source, receiver=receiver)
        assert abs(float(pair.rates) - paper) < 4 * float(pair.rates_stderr) + digit / 2
    error = names["error"]
    assert error["chosen"] < 1.3 * error["the calibrating chains"] < 0.1 * error["the paper's, procedure L"]
    assert names["models"]["chosen"].n_parameters < names["models"]["the paper's, procedure L"].n_parameters


def test_from_lammps_to_a_model(executed):
    names, _ = executed("2_from_lammps_to_a_model")
    assert float(names["off"]) < 1e-5
    np.testing.assert_allclose(names["transfer"].mean.sum(-1), 1, atol=1e-12)
    assert names["transfer"].block_counts == (1, 1)
    assert float(names["distance"].mean()) < 1e-3


def test_extend_it(executed):
    names, printed = executed("3_extend_it")
    errors = [float(line.split()[-1]) for line in printed.splitlines() if line.startswith("step")]
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2, rtol=0.1)  # first order
    assert names["again"].n_parameters == 1
    assert names["again"].calibration.model == "one_rate"
    assert {"participation", "symplectic_euler", "one_rate"} <= {*tc.OBSERVABLES, *tc.METHODS, *tc.MODELS}


def test_outputs_are_kept_as_jupyter_keeps_them(tmp_path):
    cells = ["a = 2\nprint(a)\na + 1", "a;", "import matplotlib.pyplot as plt\nf = plt.figure()", "f"]
    book = {"cells": [{"cell_type": "code", "source": text, "outputs": []} for text in cells]}
    (tmp_path / "a.ipynb").write_text(json.dumps(book))
    here = os.getcwd()
    names, outputs = RUN["execute"](tmp_path / "a.ipynb")
    assert os.getcwd() == here
    assert names["a"] == 2
    assert [[o["output_type"] for o in found] for found in outputs] == [
        ["stream", "execute_result"], [], ["display_data"], ["display_data"],
    ]  # fmt: skip
    with contextlib.redirect_stdout(None):
        assert RUN["main"]([str(tmp_path / "a.ipynb")]) == 0
    saved = json.loads((tmp_path / "a.ipynb").read_text())["cells"]
    assert saved[0]["outputs"][1]["data"]["text/plain"] == ["3"]
