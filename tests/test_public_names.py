import pkgutil
import subprocess
import sys

import torchchain as tc


def test_every_public_name_resolves():
    assert tc.__all__ == sorted(tc._HOME)
    for name in tc.__all__:
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


def test_unknown_names():
    try:
        _ = tc.Chains
    except AttributeError as error:
        assert str(error) == "module 'torchchain' has no attribute 'Chains'"
    else:
        raise AssertionError("an unknown name must be an AttributeError")


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, torchchain; sys.exit(any(m in sys.modules for m in ('torch', 'numpy', 'xarray', 'matplotlib')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
