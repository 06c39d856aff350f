import contextlib
import inspect
import pkgutil
import subprocess
import sys
import typing
from pathlib import Path

import pytest

import torchchain as tc

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs" / "_ext"))
import api_pages


def test_every_public_name_resolves():
    assert tc.__all__ == sorted(tc.__all__)
    assert set(tc.__all__) <= set(tc._HOME)
    for name in tc._HOME:
        assert getattr(tc, name) is not None
    assert set(tc.__all__) <= set(dir(tc))


def test_no_public_name_hides_a_module():
    # "from torchchain import x" must give one thing, whatever was imported before.
    modules = {module.name for module in pkgutil.iter_modules(tc.__path__)}
    assert {"chain", "energy", "ensemble"} <= modules
    assert not modules & set(tc.__all__)


def test_names_the_design_promises():
    promised = """Disorder Chain impulse standing_wave evolve normal_modes particle_energy energy_center energy_width
        band_energy long_time_band_energy Impulse StandingWave Scene simulate band_transfer BandTransfer calibrate
        MasterEquation plan Plan""".split()
    assert set(promised) <= set(tc.__all__)
    assert len(tc.__all__) < 40, "everyday names only: the others belong to a room"


def test_unknown_names():
    try:
        _ = tc.Chains
    except AttributeError as error:
        assert str(error) == "module 'torchchain' has no attribute 'Chains'"
        assert (error.name, error.obj) == ("Chains", tc), "for Python's own suggestion"
    else:
        raise AssertionError("an unknown name must be an AttributeError")


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, torchchain; sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'xarray', 'matplotlib')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_names_that_were_public_before():
    earlier = """BandTransfer Chain Disorder Impulse Linearity LinearityWarning METHODS MasterEquation MasterFamily
        MemoryModel NormalModes Plan RateModel SOLVERS Scaling Scene SwingInModel StandingWave State TrustWarning
        Trajectory band_energy band_transfer basis_fraction bin_energy calibrate calibrate_family chapman_kolmogorov
        count_modes_below energy_center energy_matrices energy_moments energy_width evolve implied_timescales impulse
        integrated_density_of_states kinetic_energy linearity long_time_band_energy lyapunov_exponent normal_modes
        particle_energy plan potential_energy simulate standing_wave statistical_distance total_energy total_variation
        wavenumber_energy wavenumber_energy_matrix weak_disorder_lyapunov zero_wavenumber_share""".split()
    for name in earlier:
        assert getattr(tc, name) is not None


def test_types_that_public_signatures_mention_are_public():
    public = api_pages.public_names() | vars(tc.localization)
    known = {id(value) for value in public.values()}

    def mentioned(hint):
        own = isinstance(hint, type) and hint.__module__.startswith("torchchain")
        return {hint} if own else set().union(*map(mentioned, typing.get_args(hint)))

    missing = set()
    for name, value in public.items():
        if not (inspect.isfunction(value) or inspect.isclass(value)) or not value.__module__.startswith("torchchain"):
            continue
        with contextlib.suppress(NameError):  # a type that only type checkers import
            hints = typing.get_type_hints(value)
            missing |= {f"{kind.__name__} of {name}" for hint in hints.values() for kind in mentioned(hint) if id(kind) not in known}
    assert not missing


def test_rooms_as_namespaces():
    assert tc.localization.lyapunov_exponent is tc.lyapunov_exponent
    assert tc.energy.energy_center is tc.energy_center
    assert tc.master.chapman_kolmogorov is tc.chapman_kolmogorov
    assert tc.evolvers.METHODS is tc.METHODS
    assert tc.ensemble.total_variation is tc.total_variation
    assert {"chain", "energy", "evolvers", "localization", "master", "network", "theory"} <= set(dir(tc))


SCRIPT = """
import torchchain as tc

scene = tc.Scene(n_particles=64, n_bands=8)
transfer = tc.band_transfer(scene)
master = tc.calibrate(transfer)
path = tc.evolve(scene.chain([0]), scene.state(scene.chain([0])), scene.times)
reveal_type(transfer)
reveal_type(master)
reveal_type(tc.plan(scene))
reveal_type(path)
reveal_type(tc.open("results").transfer)
reveal_type(tc.localization.lyapunov_exponent)
tc.Scene(particles=3)
tc.nothing
raise tc.TrustWarning
"""


def test_a_type_checker_knows_what_a_name_is(tmp_path):
    mypy = pytest.importorskip("mypy.api", reason="mypy comes with the extra dev")
    script, config = tmp_path / "script.py", tmp_path / "mypy.ini"
    script.write_text(SCRIPT)
    libraries = [
        "torch",
        "numpy",
        "scipy",
        "xarray",
        "matplotlib",
        "numba",
        "torchdiffeq",
    ]  # large, and not in question
    skipped = "".join(f"[mypy-{name}.*]\nfollow_imports = skip\n" for name in libraries)
    config.write_text(f"[mypy]\nignore_missing_imports = True\nfollow_imports = silent\n{skipped}")
    report, _, _ = mypy.run([str(script), f"--config-file={config}", f"--cache-dir={tmp_path}"])
    revealed = [line.partition('"')[2].rstrip('"') for line in report.splitlines() if "Revealed type" in line]
    expected = ("BandTransfer", "MasterEquation", "Plan", "Trajectory", "BandTransfer", "def (")
    assert len(revealed) == len(expected), report
    for kind, name in zip(revealed, expected, strict=True):
        assert name in kind
    assert "Unexpected keyword argument" in report
    assert 'Module has no attribute "nothing"' in report
    assert "TrustWarning" not in report, "an earlier name is one"
