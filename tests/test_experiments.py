"""The figure scripts: every one runs, leaves its files, redraws without a run, and says in one line what is wrong."""

from __future__ import annotations

import importlib
import json
import math
import re
import sys
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray
from matplotlib.text import Text

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "experiments"))

import chart_evolvers
import chart_summary
import error_bars
import fig09
import fig12
import fig14
import harness
import readme_numbers
import run_all

from torchchain import plots

FILES = ("config.toml", "results.nc", "figure.png", "report.txt", "run.json")
SCRIPTS = {
    name: module.SCRIPT
    for name, module in ((name, importlib.import_module(name)) for name in run_all.names())
    if hasattr(module, "SCRIPT")
}


@pytest.fixture(scope="module")
def smoke(tmp_path_factory, rendered_here):
    """Smoke run of a script, made once; returns its folder."""
    folder = tmp_path_factory.mktemp("experiments")

    @cache
    def run(name):
        arguments = ["--smoke", "--out", str(folder / name)]
        if name == "chart_summary":
            for chart in chart_summary.CHARTS:
                run(chart.SCRIPT.name)
            arguments += ["--results", str(folder)]
        good, line = run_all.run_one(name, arguments)
        assert good, line
        return folder / name

    return run


@pytest.fixture(params=SCRIPTS)
def done(request, smoke):
    """A script and the folder of its smoke run."""
    return SCRIPTS[request.param], smoke(request.param)


def table(out: Path) -> xarray.Dataset:
    with xarray.open_dataset(out / "results.nc", engine="h5netcdf") as data:
        return data.load()


def test_smoke_run_leaves_its_files(done):
    script, out = done
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    assert (out / "figure.png").read_bytes().startswith(b"\x89PNG")
    config = tomllib.loads((out / "config.toml").read_text())
    record = json.loads((out / "run.json").read_text())
    assert record["command"].startswith(f"python experiments/{script.name}.py --smoke")
    assert record["seed"] == config["seed"] == script.smoke.seed
    assert {"versions", "device", "threads", "seconds", "config_sha256"} <= record.keys()


def test_figures_are_as_a_referee_wants_them(done):
    """From the saved data: page width, panel letters used once, true symbols, no legend on the data."""
    script, out = done
    figure = harness.drawn(script, table(out), script.smoke)
    assert figure.get_figwidth() <= plots.PAGE + 1e-9
    titles = [ax.get_title(where) for ax in figure.axes for where in ("left", "center", "right")]
    letters = re.findall(r"^\(([a-z])\)", "\n".join(titles), re.M)
    assert len(set(letters)) == len(letters), titles
    for text in figure.findobj(Text):
        outside_math = re.sub(r"\$.*?\$", "", text.get_text())
        assert not re.search(r"\bxi\b|\^|<=|>=", outside_math), text.get_text()
    for ax in figure.axes:
        if ax.get_legend() is not None:
            assert ax.get_legend().get_bbox_to_anchor() is not ax.bbox, ax.get_title("left")


def test_table_is_printed_and_saved(done):
    """And is made again from the saved data, which is all that a redraw does for it."""
    script, out = done
    data, report = table(out), (out / "report.txt").read_text()
    assert data.sizes["row"] >= 1
    assert np.isfinite(data.row_measured.values).all()
    for quantity, measured in zip(data.row_quantity.values, data.row_measured.values, strict=True):
        assert quantity in report
        assert f"{measured:.4g}" in report
    assert len(report.splitlines()) > data.sizes["row"] + 2, "words below the table"
    saved = tomllib.loads((out / "config.toml").read_text())
    config = replace(script.smoke, **{name: tuple(v) if isinstance(v, list) else v for name, v in saved.items()})
    assert harness._report(script, data, config, script.compare(data, config)) == report


@pytest.mark.parametrize("name", ["fig12", "plan_grid"])
def test_redraw_runs_nothing(name, smoke):
    script, out = SCRIPTS[name], smoke(name)
    report, before = (out / "report.txt").read_text(), {name: (out / name).stat().st_mtime_ns for name in FILES}
    (out / "figure.png").unlink()

    def refuse(*_):
        raise AssertionError("a redraw must not measure")

    assert harness.run(replace(script, measure=refuse), ["--redraw", "--out", str(out)]) == 0
    assert (out / "figure.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "report.txt").read_text() == report
    for name in ("config.toml", "results.nc", "run.json"):
        assert (out / name).stat().st_mtime_ns == before[name]


@pytest.mark.parametrize(
    ("config", "flags", "words"),
    [
        ("relizations = 3", [], "relizations"),
        ("seed = 'many'", [], "seed"),
        ("seed = [", [], "TOML"),
        ("n_particles = 255", ["--smoke"], "n_particles must be even"),
        ("", ["--realizations", "0"], "realizations must be at least 1, got 0"),
        ("", ["--no-such-flag"], "no-such-flag"),
        ("", ["--smoke", "--device", "abacus"], "device must be available here"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, config, flags, words):
    file, out = tmp_path / "config.toml", tmp_path / "out"
    file.write_text(config)
    assert fig12.main(["--config", str(file), "--out", str(out), *flags]) == 2
    error = capsys.readouterr().err
    assert error.startswith("fig12: error: ")
    assert words in error
    assert error.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize("name", ["fig12", "scorecard"])
def test_unknown_config_key(name, tmp_path, capsys):
    file = tmp_path / "config.toml"
    file.write_text("no_such_key = 1")
    assert harness.run(SCRIPTS[name], ["--config", str(file), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "no_such_key" in error
    assert error.count("\n") == 1


def test_flags_override_config_overrides_smoke(tmp_path):
    file, out = tmp_path / "config.toml", tmp_path / "out"
    file.write_text("seed = 3\nrealizations = 2\n")
    assert fig12.main(["--smoke", "--config", str(file), "--seed", "5", "--out", str(out)]) == 0
    saved = tomllib.loads((out / "config.toml").read_text())
    assert (saved["seed"], saved["realizations"], saved["stop"]) == (5, 2, fig12.SMOKE.stop)
    assert fig12.main(["--config", str(out / "config.toml"), "--out", str(tmp_path / "again")]) == 0
    assert table(tmp_path / "again").equals(table(out)), "the saved config makes the same data again"


def test_redraw_keeps_the_settings(tmp_path, capsys):
    out = ["--out", str(tmp_path / "out")]
    assert fig12.main(["--redraw", *out]) == 2
    assert "config" in capsys.readouterr().err
    assert fig12.main(["--smoke", *out]) == 0
    capsys.readouterr()
    assert fig12.main(["--redraw", "--seed", "7", *out]) == 2
    assert "seed must stay 0" in capsys.readouterr().err


def test_runs_of_pieces_are_joined(tmp_path, capsys):
    piece, whole = str(tmp_path / "piece"), str(tmp_path / "whole")
    assert chart_evolvers.main(["--smoke", "--out", piece]) == 0
    assert chart_evolvers.main(["--join", piece, piece, "--out", whole]) == 0
    with xarray.open_dataset(f"{piece}/results.nc", engine="h5netcdf") as data:
        runs = data.sizes["run"]
    with xarray.open_dataset(f"{whole}/results.nc", engine="h5netcdf") as data:
        assert (data.sizes["scene"], data.sizes["run"]) == (2, 2 * runs)
    assert chart_evolvers.main(["--redraw", "--out", whole]) == 0  # with the settings of both
    capsys.readouterr()
    assert chart_evolvers.main(["--smoke", "--seed", "7", "--out", str(tmp_path / "other")]) == 0
    assert chart_evolvers.main(["--join", piece, str(tmp_path / "other"), "--out", whole]) == 2
    assert "join must name runs that differ in waves alone" in capsys.readouterr().err
    assert fig12.main(["--join", piece, "--out", whole]) == 2


def test_numbers_of_the_documents_are_stated_and_read(monkeypatch, tmp_path, capsys):
    stated = readme_numbers.documents()
    for number in readme_numbers.NUMBERS:
        assert number.said in stated
        assert number.command == readme_numbers.HEADLINE or number.command in run_all.names()
        assert number.low < number.high or number.low == 1
    asked = []
    monkeypatch.setattr(readme_numbers, "made", lambda command, out, seed: asked.append((command, seed)) or out)
    table = [
        readme_numbers.Number("of 100 varied scenes", "plan_grid", lambda out: 0.5, 0.4, 0.6, True, seeds=3),
        readme_numbers.Number("of 100 varied scenes", "plan_grid", lambda out: 0.7, 0.4, 0.6, True),
        readme_numbers.Number("99 of 98", "plan_grid", lambda out: 0.5, 0.4, 0.6, True),
        readme_numbers.Number("of 100 varied scenes", "growth", lambda out: 0.5, 0.4, 0.6),
    ]
    monkeypatch.setattr(readme_numbers, "NUMBERS", table)
    assert readme_numbers.main(["--out", str(tmp_path)]) == 1
    assert asked == [("plan_grid", 0), ("plan_grid", 1), ("plan_grid", 2)]
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines] == ["ok", "FAILS", "NOT STATED", "1 more with --all"]


def test_run_all_reports_a_failure(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(run_all, "names", lambda: ["fig12", "no_such_script"])
    assert run_all.main(["--smoke", "--out", str(tmp_path)]) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("ok     fig12")
    assert second.startswith("FAILED no_such_script")
    assert (tmp_path / "fig12" / "figure.png").is_file()


def test_the_error_of_a_mean_over_pairs_is_that_of_both_its_ensembles():
    one, other = (torch.randn(n, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64) for n in (7, 5))
    mean, error = error_bars.over_pairs(one[:, None] + other[None], False)
    torch.testing.assert_close(mean, one.mean(0) + other.mean(0))
    torch.testing.assert_close(error.square(), one.var(0) / 7 + other.var(0) / 5)
    same = one[:, None] + one[None]
    mean, error = error_bars.over_pairs(same + 1e6 * torch.eye(7, dtype=torch.float64)[..., None], True)  # none with itself
    torch.testing.assert_close(mean, 2 * one.mean(0))
    torch.testing.assert_close(error, 2 * (one.var(0) / 7).sqrt())


def test_jackknife_of_a_mean_is_its_standard_error():
    blocks = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    value, error = harness.jackknife(blocks, [5] * 20, lambda mean: mean)
    torch.testing.assert_close(value, blocks.mean(0))
    torch.testing.assert_close(error, blocks.std(0) / 20**0.5)
    assert harness.jackknife(blocks[:1], [5], lambda mean: mean)[1].isnan().all()


def test_sigmas_count_both_ensembles_and_the_paper_s_rounding():
    assert harness.Row("", 0.12, 0.01, "0.10").sigmas == pytest.approx(0.02 / math.sqrt(2e-4 + 1e-4 / 12))
    assert math.isnan(harness.Row("", 0.12, 0.01).sigmas)


def test_rates_of_fig_14_are_the_paper_s():
    config = fig14.Config(realizations=40, stop=5.0, fit_steps=(0.25,), late=(50.0,))
    rows = [row for row in fig14.compare(fig14.measure(config, "cpu"), config) if "  L, dt = 0.25" in row.quantity]
    assert [row.paper for row in rows] == ["-0.18", "0.0079"]
    assert all(abs(row.sigmas) < 4 for row in rows)


def test_eq_28_as_printed_is_what_puts_the_energy_on_light_particles():
    data = fig09.measure(replace(fig09.SMOKE, stop=256.0), "cpu")
    light = data.light_among_top.mean("realization")
    assert float(light.sel(case="Eq. 26")) <= 1
    assert float(light.sel(case="Eq. 28 as printed")) >= 3


def test_no_conclusions_from_other_settings(tmp_path, rendered):
    out = tmp_path / "fig12"
    assert fig12.main(["--smoke", "--kind", "uniform", "--format", "pdf", "--out", str(out)]) == 0
    text = (out / "report.txt").read_text()
    assert re.search(r"no conclusions: not the paper's .*\bkind\b", text)
    assert "paper " not in text.splitlines()[1]
    assert (out / "figure.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("name", [name for name in SCRIPTS if name.startswith("fig")])
def test_the_papers_own_settings_are_its_own(name):
    script = SCRIPTS[name]
    assert harness.changed(script, replace(script.config, seed=7, realizations=9)) == []
    assert harness.changed(script, replace(script.config, kind="binary")) == ["kind"]


def test_labels_longer_than_their_panel_are_on_several_lines():
    figure, axes = plots.figure(plots.PAGE, 2.0, 1, 3)
    words = "a label that is far too long for a panel of this height"
    axes[0, 0].set(ylabel=words, title="short")
    axes[0, 1].set(ylabel=r"$\sum_{r \neq s} Q_{sr}$ and words that go on and on", title=words * 2)
    harness.wrapped_labels(figure)
    assert "\n" in axes[0, 0].get_ylabel()
    assert axes[0, 0].get_ylabel().split() == words.split()
    assert axes[0, 0].get_title() == "short"
    assert "\n" not in axes[0, 1].get_ylabel()  # formulas are not broken
    assert "\n" in axes[0, 1].get_title()
