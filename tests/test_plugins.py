"""An observable, a method and a model from outside, through everything that the library's own go through."""

import json
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
import torch

import torchchain as tc
from torchchain import cli
from torchchain.cli import outputs

SMALL = "--n-particles 32 --n-bands 4 --realizations 6 --times.stop 5 --seed 5".split()
PLUGIN = """
from dataclasses import dataclass
import torch
import torchchain as tc


def momentum(scene, chain, trajectory):
    return (chain.masses[(slice(None), *[None] * (trajectory.velocity.ndim - 2))] * trajectory.velocity).sum(-1)


tc.register_observable(tc.Observable("outside_momentum", ("time",), "1", "total momentum", momentum))


def start(chain, state):
    def advance(times):
        return tc.evolve(chain, state, times, method="modes")

    return advance


tc.register_method(tc.Method("outside_modes", start, "the modes, from outside"))


def still(sample, recipe, near, progress):
    n = sample.n_bands
    return tc.RateModel(torch.zeros(n, n, dtype=torch.float64), torch.ones(n, dtype=torch.float64)), None


tc.register_model(
    tc.ReducedModel("outside_still", "nothing moves", tc.RateModel, (tc.Fit("outside_rest", "no fit", still),),
                    lambda n, damped, settings: 0)
)
"""


@pytest.fixture(autouse=True)
def plugin(tmp_path, monkeypatch):
    """A folder with the plugin; the registries are as before when the test is over."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torchchain.cli.plugins._loaded", set())
    monkeypatch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
    (tmp_path / "outside.py").write_text(PLUGIN)
    registries = (tc.OBSERVABLES, tc.METHODS, tc.MODELS)
    before = [dict(registry) for registry in registries]
    yield tmp_path / "outside.py"
    for registry, entries in zip(registries, before, strict=True):
        registry.clear()
        registry.update(entries)


def test_simulate_with_an_observable_and_a_method_from_outside(plugin, capsys):
    arguments = ["simulate", *SMALL, "--plugin", "outside.py", "--method", "outside_modes", "--observables"]
    assert cli.main([*arguments, "outside_momentum", "center", "--out", "out"]) == 0
    run = tc.open("out")
    assert run.data["outside_momentum"].dims == ("tone", "time")
    assert run.data["outside_momentum"].attrs["long_name"] == "total momentum"
    np.testing.assert_allclose(run.data["outside_momentum"].diff("time"), 0, atol=1e-12)  # of a ring: conserved
    assert run.config["plugins"] == [str(plugin)]
    assert run.record["plugins"] == {str(plugin): outputs.sha256(plugin)}
    assert run.record["resolved"]["method"] == "outside_modes"
    expected = tc.simulate(run.scene, "modes")
    np.testing.assert_allclose(run.data["center"], expected["center"], rtol=1e-12)
    assert cli.main(["rerun", "out"]) == 0
    assert cli.main(["simulate", "--config", "out/config.toml", "--method", "modes", "--out", "from_config"]) == 0
    assert "outside_momentum" in tc.open("from_config").data


def test_the_plan_knows_an_observable_from_outside(plugin, capsys):
    assert cli.main(["plan", *SMALL, "--plugin", "outside.py", "--observables", "outside_momentum"]) == 0
    assert "method" in capsys.readouterr().out
    scene = tc.Scene(n_particles=32, n_bands=4, realizations=6, observables=("outside_momentum",))
    assert tc.plan(scene).predicted_seconds > 0


def test_a_checkpoint_of_an_observable_from_outside(plugin):
    assert cli.main(["plan", *SMALL[:4], "--plugin", "outside.py"]) == 0
    scene = tc.Scene(
        n_particles=32, n_bands=4, realizations=6, times=torch.arange(5.0), observables=("outside_momentum",)
    )
    whole = tc.simulate(scene, "outside_modes")
    kept = tc.simulate(scene, "outside_modes", checkpoint="kept")
    again = tc.simulate(scene, "outside_modes", checkpoint="kept")
    for other in (kept, again):
        assert other["outside_momentum"].identical(whole["outside_momentum"])


def test_a_model_from_outside_is_fitted_saved_and_loaded(plugin, capsys):
    arguments = ["calibrate", *SMALL, "--method", "modes", "--plugin", "outside.py", "--model", "outside_still"]
    assert cli.main([*arguments, "--out", "out"]) == 0
    master = tc.open("out").master
    assert (master.calibration.model, master.calibration.method) == ("outside_still", "outside_rest")
    start = torch.eye(4, dtype=torch.float64)
    assert torch.equal(master.solve(start, [3.0])[:, 0], start)
    assert cli.main(["rerun", "out"]) == 0
    assert (
        cli.main(["calibrate", "--transfer", "out", "--fit", "outside_rest", "--plugin", "outside.py", "--out", "two"])
        == 0
    )
    assert tc.open("two").master.calibration.model == "outside_still"
    assert cli.main(["predict", "out", "--out", "pred"]) == 0
    np.testing.assert_array_equal(tc.open("pred").prediction.isel(time=-1).values, np.eye(4))


def test_a_new_process_and_a_module_on_the_path(plugin):
    """What a shell does: nothing is registered but by the flag, from a module as well as from a file."""
    arguments = ["simulate", *SMALL, "--observables", "outside_momentum", "--method", "modes", "--out", "out"]
    command = [sys.executable, "-m", "torchchain", *arguments]
    unknown = subprocess.run(command, capture_output=True, text=True, check=False)
    assert unknown.returncode == 2
    assert "observables must be one of" in unknown.stderr
    done = subprocess.run([*command, "--plugin", "outside"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(open("out/run.json").read())["plugins"] == {}


def test_packages_that_announce_themselves(plugin, tmp_path, monkeypatch):
    folder = tmp_path / "site" / "outside-1.0.dist-info"
    os.makedirs(folder)
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[torchchain]\nmine = announced\n")
    (tmp_path / "site" / "announced.py").write_text(textwrap.dedent(PLUGIN))
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert cli.main(["simulate", *SMALL, "--observables", "outside_momentum", "--method", "modes", "--out", "out"]) == 0
    assert "outside_momentum" in tc.open("out").data
    sys.modules.pop("announced")
