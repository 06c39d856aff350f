"""Every flag, every field of a config and every file with something hostile in it: one line that names it, nothing half-written."""

import builtins
import contextlib
import copy
import dataclasses
import importlib
import io
import json
import os
import pickle
import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest
import torch
import xarray
from safetensors.torch import load_file, save_file
from taken import LITTLE, Taken

import torchchain as tc
from torchchain import cli
from torchchain.checks import FieldError, FieldTypeError
from torchchain.cli import flags, outputs

SMALL = "--n-particles 16 --n-bands 4 --realizations 4 --times.stop 6 --times.step 0.5 --method modes".split()
B = 4


class Reached(RuntimeError):
    """Everything was right so far: the computation would begin."""


@pytest.fixture(scope="module")
def transfer():
    scene = tc.Scene(n_particles=16, n_bands=B, realizations=8, times=np.arange(0, 8.01, 0.5), seed=3)
    return tc.band_transfer(scene, "modes")


@pytest.fixture(scope="module")
def masters(transfer):
    """One of every kind, without and with error bars."""
    ways = {
        "markov": {"method": "linear", "model": "basis_matrix"},
        "swing_in": {"method": "linear", "model": "swing_in"},
        "memory": {"order": (1, 1)},
    }
    return {
        f"{name}{' with errors' if count else ''}": tc.calibrate(transfer, bootstrap=count, **way)
        for name, way in ways.items()
        for count in (0, 2)
    }


@pytest.fixture(scope="module")
def family(transfer):
    other = dataclasses.replace(transfer, scene=dataclasses.replace(transfer.scene, disorder=tc.Disorder(strength=0.2)))
    return tc.calibrate_family([transfer, other], order=(1, 0), bootstrap=2)


@pytest.fixture
def nothing_computed(monkeypatch):
    """Where a run would begin, it stops."""

    def stop(*arguments, **settings):
        raise Reached("reached")

    for place in ("simulate.simulate", "calibrate.band_transfer", "dispatch.plan"):
        monkeypatch.setattr(f"torchchain.cli.{place}", stop)
    monkeypatch.setattr("torchchain.ensemble.plan.resolved", lambda scene: scene)
    monkeypatch.setattr(tc.MasterEquation, "solve", stop)


# Every flag of every command


def flags_of(kind, prefix=""):
    """The flags of a command and of its tables."""
    for entry in dataclasses.fields(kind):
        inner = flags.__dict__.get(str(entry.type))
        if dataclasses.is_dataclass(inner):
            yield from flags_of(inner, f"{prefix}{entry.name}.")
        else:
            yield prefix + entry.name


WORDS = ("nan", "-inf", "-1", "1e300", "1e-300", "word", "", "99999999999999999999")
POSITIONAL = {("compare", "a"), ("compare", "b"), ("sweep", "command"), ("sweep", "fields"), ("import", "runs"), ("convert", "run"), ("convert", "out")}  # fmt: skip
SHARED = set(flags_of(flags.SceneFlags))
EVERY_FLAG = [
    (command, flag)
    for command, kind in flags.COMMANDS.items()
    for flag in flags_of(kind)
    if not (command != "simulate" and flag in SHARED)
    and command not in {"import", "convert"}  # in test_import.py
    and (command, flag) not in {("predict", "model"), ("rerun", "folder"), ("family", "models"), *POSITIONAL}
]
FREE = {"out", "config", "artifact"}  # any word may be the name of a file
ALSO = {
    ("simulate", "times.start"): ("times.stop",),
    ("simulate", "times.stop"): ("times.step",),
    ("predict", "times.start"): ("times.stop",),
    ("predict", "times.stop"): ("times.step",),
    ("calibrate", "fit"): ("method must be",),
    ("family", "out"): ("file nothing must be a readable file",),
    ("compare", "out"): ("file nothing must be a readable data file",),
    ("simulate", "config"): ("No such file",),
    ("plan", "artifact"): ("No such file",),
    ("predict", "config"): ("No such file",),
}


def test_every_flag_is_here():
    assert len(EVERY_FLAG) > 45
    assert {"disorder.strength", "times.step", "excitation.tones", "checkpoint_every"} <= {
        flag for _, flag in EVERY_FLAG
    }


@pytest.mark.usefixtures("nothing_computed")
@pytest.mark.parametrize(("command", "flag"), EVERY_FLAG)
def test_hostile_words_for_every_flag(command, flag, run, masters, family, tmp_path):
    """Refused by name with status 2, or good; never a traceback, and nothing is left behind."""
    model = tmp_path / "model.safetensors"
    if command == "predict":
        (family if flag == "strength" else masters["markov"]).save(model)
    begin = {
        "simulate": SMALL, "calibrate": SMALL, "plan": SMALL[:-2], "predict": [str(model)], "rerun": ["nothing"], "family": ["nothing"],
        "compare": ["nothing", "nothing"], "sweep": ["simulate", "n_particles=8,16", "n_bands=2"], "import": ["nothing"], "convert": ["nothing", "out.nc"],
    }[command]  # fmt: skip
    kind = ["--excitation.kind", "impulse"] if flag in ("excitation.site", "excitation.velocity") else []
    before = sorted(os.listdir(tmp_path))
    refused = 0
    for word in WORDS:
        if flag == "out" and word == "":
            continue  # the present folder
        status, output, errors = run(command, *begin, *kind, f"--{flag.replace('_', '-')}", word)
        assert errors.startswith("torchchain: error: "), (word, errors, output)
        assert errors.count("\n") == 1
        assert output == ""
        assert sorted(os.listdir(tmp_path)) == before
        if "reached" in errors:
            assert status == 1
            continue
        assert status == 2
        refused += 1
        name = flag.split(".")[-1]
        known = (*ALSO.get((command, flag), ()), name, name.replace("_", "-"))
        if command != "rerun":
            assert any(one in errors for one in known), (word, errors)
    assert refused >= (0 if flag in FREE | {"seed"} else 3)


# Every field of every config


TOML = (
    "nan", "inf", "-inf", "0", "-1", "1e300", "-1e-300", "true", "''", "'word'", "'''two\nlines'''", "[]", "[[]]", "[nan]", "[true]",
    "['a', 1]", "{}", "{a = 1}", "99999999999999999999999", "1979-05-27", "07:32:00",
)  # fmt: skip
KINDS = {"disorder": tc.Disorder, "stiffness_disorder": tc.Disorder, "si": None, "excitation": tc.StandingWave}
FIELDS = (
    [entry.name for entry in dataclasses.fields(tc.Scene)]
    + [f"{table}.{entry.name}" for table, kind in KINDS.items() if kind for entry in dataclasses.fields(kind)]
    + [f"impulse.{entry.name}" for entry in dataclasses.fields(tc.Impulse)]
    + [f"si.{name}" for name in ("radius", "density", "young_modulus", "poisson_ratio", "force", "times", "velocity", "amplitude", "damping")]
    + ["times.start", "times.stop", "times.step", "excitation.kind"]
)  # fmt: skip
BEADS = {"radius": "0.01", "density": "7800.0", "young_modulus": "2e11", "poisson_ratio": "0.3", "force": "10.0"}


def config(field, value):
    """A scene file with this value of this field."""
    if "." not in field:
        return f"{field} = {value}\n"
    table, name = field.split(".")
    rest = {
        "si": {key: good for key, good in BEADS.items() if key != name},
        "times": {key: good for key, good in {"stop": "5.0", "step": "0.5"}.items() if key != name},
        "impulse": {"kind": "'impulse'"},
    }.get(table, {})
    lines = [f"{key} = {good}" for key, good in rest.items()]
    if (table, name) == ("si", "velocity"):
        return "\n".join(["[si]", *lines, f"{name} = {value}", "[excitation]", "kind = 'impulse'"])
    return "\n".join([f"[{'excitation' if table == 'impulse' else table}]", *lines, f"{name} = {value}"])


@pytest.mark.parametrize("field", FIELDS)
def test_hostile_values_of_every_field(field, tmp_path):
    path, refused = tmp_path / "scene.toml", 0
    for value in TOML:
        path.write_text(config(field, value))
        with Taken() as taken, contextlib.suppress(FieldError, FieldTypeError):
            tc.Scene.from_toml(path)
        assert taken.largest < LITTLE
        try:
            scene = tc.Scene.from_toml(path)
        except (FieldError, FieldTypeError) as error:
            refused += 1
            assert "\n" not in str(error)
            words = (field.split(".")[-1], field.split(".")[0], "times" if "times" in field else field)
            assert any(word in str(error) for word in words), (value, str(error))
        else:  # a scene that says the same again
            assert tc.Scene.from_dict(scene.to_dict()).to_dict() == scene.to_dict()
            assert torch.isfinite(scene.times).all()
    assert refused >= 12


@pytest.mark.usefixtures("nothing_computed")
@pytest.mark.parametrize(
    "field", ["method", "model", "window", "constraint", "penalty", "steps", "learning_rate", "tolerance", "order"]
)
def test_hostile_values_of_every_field_of_a_calibration(field, run, tmp_path):
    refused = 0
    way = "" if field in ("method", "model", "order") else "method = 'adam'\n"
    for value in TOML:
        (tmp_path / "scene.toml").write_text(f"[calibration]\n{way}{field} = {value}\n")
        status, output, errors = run("calibrate", *SMALL, "--config", "scene.toml", "--out", "out")
        assert (output, errors.count("\n")) == ("", 1)
        assert errors.startswith("torchchain: error: ")
        assert os.listdir(tmp_path) == ["scene.toml"]
        if "reached" not in errors:
            assert status == 2
            assert field in errors
            refused += 1
    assert refused >= 15


# Places


@pytest.mark.usefixtures("nothing_computed")
def test_places_that_are_not_to_be_written_are_refused_before_a_run(run, tmp_path):
    (tmp_path / "file").write_text("mine")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "to_file").symlink_to("file")
    for out in (
        "file",
        "file/below",
        "file/below/that",
        "loop",
        "loop/below",
        "dangling",
        "to_file",
        "x" * 300,
        "a\0b",
        "/dev/null",
        "/dev/null/x",
    ):
        status, output, errors = run("simulate", *SMALL, "--out", out)
        assert (status, output, errors.count("\n")) == (2, "", 1), (out, errors)
        assert "out must be" in errors
    assert sorted(os.listdir(tmp_path)) == ["dangling", "file", "loop", "to_file"]
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("out", ["/proc/torchchain/out", "/proc/self/out"])
def test_a_folder_that_cannot_be_written_is_found_out(out, run, tmp_path):
    if not os.path.isdir("/proc/self"):
        pytest.skip("no /proc")
    status, output, errors = run("simulate", *SMALL, "--observables", "center", "--out", out)
    assert (status, output, errors.count("\n")) == (2, "", 1)
    assert f"out must be writable, got {out}" in errors
    assert os.listdir(tmp_path) == []


def test_a_link_to_a_folder_is_followed(run, tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "figure", lambda drawn: lambda path: path.write_bytes(b""))
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    status, _, errors = run("simulate", *SMALL, "--observables", "center", "--out", "link")
    assert (status, errors) == (0, "")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "results.nc").exists()
    assert sorted(os.listdir(tmp_path)) == ["link", "real"]


@pytest.mark.parametrize("kind", ["model", "family"])
def test_models_are_written_whole_or_not_at_all(kind, masters, family, tmp_path):
    made = masters["memory"] if kind == "model" else family
    (tmp_path / "file").write_text("mine")
    for place in ("nowhere/x.safetensors", "file/x", "/proc/x.safetensors", "x" * 300, "a\0b", "."):
        with pytest.raises(FieldError, match="must be writable") as caught:
            made.save(place if place.startswith(("/", "a")) else tmp_path / place)
        assert "\n" not in str(caught.value)
    for wrong in (None, 3, b"x", [], 1j):
        with pytest.raises(FieldTypeError, match="path must be"):
            made.save(wrong)
        with pytest.raises(FieldTypeError, match="path must be"):
            type(made).load(wrong)
    assert os.listdir(tmp_path) == ["file"]


# Model files


KINDS_OF_MODELS = [name + errors for name in ("markov", "swing_in", "memory") for errors in ("", " with errors")]


@pytest.mark.parametrize("kind", KINDS_OF_MODELS)
def test_every_kind_of_model_is_written_as_it_was_read(kind, masters, tmp_path):
    """Byte by byte, through two rounds."""
    paths = [tmp_path / str(i) for i in range(3)]
    masters[kind].save(paths[0])
    for before, after in zip(paths, paths[1:], strict=False):
        tc.MasterEquation.load(before).save(after)
    assert paths[0].read_bytes() == paths[1].read_bytes() == paths[2].read_bytes()
    again = tc.MasterEquation.load(paths[0])
    eye = torch.eye(B, dtype=torch.float64)
    assert torch.equal(again.solve(eye, [0.0, 3.0]), masters[kind].solve(eye, [0.0, 3.0]))
    assert (again.uncertainty is None) == (masters[kind].uncertainty is None)
    if again.uncertainty is not None:
        assert torch.equal(again.standard_error(eye, [3.0]), masters[kind].standard_error(eye, [3.0]))


def test_a_family_is_written_as_it_was_read(family, tmp_path):
    paths = [tmp_path / str(i) for i in range(3)]
    family.save(paths[0])
    for before, after in zip(paths, paths[1:], strict=False):
        tc.MasterFamily.load(before).save(after)
    assert paths[0].read_bytes() == paths[1].read_bytes() == paths[2].read_bytes()
    assert torch.equal(tc.MasterFamily.load(paths[0]).at(0.25).basis, family.at(0.25).basis)


class Bomb:
    """What a pickle can do."""

    def __reduce__(self):
        return os.system, ("touch exploded",)


CODE = "__import__('os').system('touch exploded')"


@contextlib.contextmanager
def nothing_runs(monkeypatch):
    """Whatever could run what a file says fails the test, and so does a new module."""

    def forbidden(*arguments, **settings):
        raise AssertionError("a file was executed")

    with monkeypatch.context() as patch:
        for owner, names in (
            (builtins, ("exec", "eval", "compile")),
            (importlib, ("import_module", "reload")),
            (pickle, ("load", "loads", "Unpickler")),
            (torch, ("load",)),
            (os, ("system", "popen", "execv", "fork")),
            (subprocess, ("Popen",)),
        ):
            for name in names:
                patch.setattr(owner, name, forbidden)
        modules = set(sys.modules)
        yield
        assert set(sys.modules) == modules


@pytest.mark.parametrize("kind", [*KINDS_OF_MODELS, "family"])
def test_reading_a_model_runs_nothing_of_it(kind, masters, family, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made, reader = (family, tc.MasterFamily) if kind == "family" else (masters[kind], tc.MasterEquation)
    path = tmp_path / "model.safetensors"
    made.save(path)
    reader.load(path)  # what it needs is imported
    header, outer, data = parts(path)
    for record in header.get("members", [header]):
        record["report"]["note"] = CODE
        record["report"][CODE] = [CODE]
        record["versions"]["os"] = CODE
        record["method"] = CODE
    write(path, header, outer, data)
    with nothing_runs(monkeypatch), pytest.raises(FieldError, match="report"):  # a record of no such fields
        reader.load(path)
    for record in header.get("members", [header]):
        del record["report"]["note"], record["report"][CODE]
        record["report"].pop("fit", None)
    write(path, header, outer, data)
    with nothing_runs(monkeypatch):
        read = reader.load(path)
    first = read.members[0] if kind == "family" else read
    assert first.calibration.method == CODE  # a word like any other
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize("reader", [tc.MasterEquation, tc.MasterFamily])
def test_a_pickle_is_no_model(reader, masters, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    buffer = io.BytesIO()
    torch.save(masters["markov"].state_dict(), buffer)
    payloads = [pickle.dumps(Bomb()), pickle.dumps(Bomb(), 0), buffer.getvalue(), CODE.encode(), b"import os\n"]
    payloads += [struct.pack("<Q", len(payloads[0])) + payloads[0], payloads[0] + bytes(1000)]
    for payload in payloads:
        (tmp_path / "model").write_bytes(payload)
        with nothing_runs(monkeypatch), pytest.raises(FieldError, match="file .* must be a master equation"):
            reader.load(tmp_path / "model")
    assert os.listdir(tmp_path) == ["model"]


def parts(path):
    """Header of torchchain, header of safetensors, data."""
    raw = path.read_bytes()
    (size,) = struct.unpack("<Q", raw[:8])
    outer = json.loads(raw[8 : 8 + size])
    return json.loads(outer["__metadata__"]["torchchain"]), outer, raw[8 + size :]


def write(path, header, outer, data):
    encoded = json.dumps({**outer, "__metadata__": {"torchchain": json.dumps(header)}}).encode()
    encoded += b" " * (-len(encoded) % 8)
    path.write_bytes(struct.pack("<Q", len(encoded)) + encoded + data)


def refused(path, reader, match=None):
    with Taken() as taken, pytest.raises((FieldError, FieldTypeError), match=match) as caught:
        reader.load(path)
    assert str(caught.value).startswith((f"file {path}", "members must"))
    assert "\n" not in str(caught.value)
    assert taken.largest < LITTLE


@pytest.fixture
def model_file(masters, tmp_path):
    path = tmp_path / "model.safetensors"
    masters["memory with errors"].save(path)
    return path


@pytest.fixture
def family_file(family, tmp_path):
    path = tmp_path / "family.safetensors"
    family.save(path)
    return path


OLD = [0, 1, -1, 2, 2.5, 1e300, True, None, "2", [2], {}]


@pytest.mark.parametrize("version", OLD)
def test_files_of_other_versions_are_refused_by_version(version, model_file, family_file):
    for path, reader in ((model_file, tc.MasterEquation), (family_file, tc.MasterFamily)):
        header, outer, data = parts(path)
        write(path, {**header, "format_version": version}, outer, data)
        refused(path, reader, "must have format version 3")
    header["members"][1]["format_version"] = version
    write(path, header, outer, data)
    refused(path, reader, "must have format version 3")


BAD_ERRORS = {
    "rates_stderr": [torch.zeros(3, 3), torch.full((B, B), -1.0), torch.full((B, B), torch.nan), torch.zeros(B), torch.zeros(B, B, dtype=torch.int64)],
    "basis_stderr": [torch.zeros(B, B + 1), torch.full((B, B), torch.inf), torch.zeros(B, B, 1), torch.zeros(B, B, dtype=torch.float16)],
    "stderr_times": [torch.zeros(0), torch.ones(1), torch.tensor([0.0]), torch.full((17,), torch.nan), torch.linspace(9, 0, 17), torch.zeros(17), torch.zeros(129), torch.linspace(-1, 0, 17)],
    "stderr": [torch.zeros(B, 3, B), torch.full((B, 17, B), torch.nan), torch.full((B, 17, B), -0.1), torch.zeros(B, 17), torch.zeros(B, 129, B), torch.zeros(0)],
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_ERRORS)
def test_error_bars_of_a_file_are_checked(name, model_file):
    header, _, _ = parts(model_file)
    good = {key: value.clone() for key, value in load_file(model_file).items()}  # not views of the file that is overwritten
    for bad in BAD_ERRORS[name]:
        save_file({**good, name: bad}, model_file, metadata={"torchchain": json.dumps(header)})
        refused(model_file, tc.MasterEquation, name)
    save_file({k: v for k, v in good.items() if k != name}, model_file, metadata={"torchchain": json.dumps(header)})
    refused(model_file, tc.MasterEquation, "hold the tensors")


@pytest.mark.parametrize("value", [None, "soon", -1, True, [], {}, 1e400, float("nan"), "inf"])
def test_the_horizon_of_a_file_is_checked(value, model_file):
    header, outer, data = parts(model_file)
    header["report"]["horizon"] = value
    write(model_file, header, outer, data)
    refused(model_file, tc.MasterEquation, "horizon")


@pytest.mark.parametrize("value", [None, "much", -1.0, [1, 2], [[0.0] * B], ["a"] * B, [float("nan")] * B, [-1.0] * B])
def test_the_damping_of_a_file_is_checked(value, model_file):
    header, outer, data = parts(model_file)
    header["report"]["damping"] = value
    write(model_file, header, outer, data)
    refused(model_file, tc.MasterEquation, "damping")


@pytest.mark.parametrize("entry", ["held_out_distance", "halves_distance", "damping", "interpolated", "order", "tried"])
def test_a_plan_with_a_model_of_odd_reports(entry, model_file):
    """What a report says is for people; where the plan takes a number of it, the number is looked at."""
    scene = tc.Scene(n_particles=16, n_bands=B, realizations=4, times=np.arange(0, 6.01, 0.5))
    for value in (None, "x", [], -1.0, 1e300, float("nan")):
        header, _, _ = parts(model_file)
        header["report"][entry] = value
        tensors = {name: x for name, x in load_file(model_file).items() if name not in BAD_ERRORS}
        path = model_file.with_name("spoiled")
        save_file(tensors, path, metadata={"torchchain": json.dumps(header)})
        try:
            plan = tc.plan(scene, artifact=path)
        except FieldError as error:
            assert str(error).startswith("file ")
        else:
            assert all(
                np.isfinite(choice.predicted_error) for choice in plan.choices if choice.method == "master equation"
            )
        model_file.with_name("spoiled").unlink()


HEADERS = {
    "no members": lambda h: h.pop("members"),
    "none": lambda h: h.update(members=[]),
    "many": lambda h: h.update(members=h["members"] * 100),
    "words": lambda h: h.update(members=["a", "b"]),
    "nothing": lambda h: h.update(members=[None, None]),
    "a table": lambda h: h.update(members={"0": 1}),
    "one missing": lambda h: h["members"].pop(),
    "twice the same": lambda h: h.update(members=[h["members"][0], h["members"][0]]),
    "another format": lambda h: h["members"][0].update(format="torchchain-scene"),
    "no kind": lambda h: h["members"][0].pop("kind"),
    "another kind": lambda h: h["members"][0].update(kind="markov"),
    "a class": lambda h: h["members"][0].update(kind="os.system"),
    "other bands": lambda h: h["members"][0].update(n_bands=2),
    "other chains": lambda h: h["members"][0]["scene"].update(n_particles=32),
    "other strength": lambda h: h["members"][0].update(strength=0.7),
    "another disorder": lambda h: h["members"][0]["scene"]["disorder"].update(kind="gamma"),
    "no scene": lambda h: h["members"][1].update(scene=None),
    "odd report": lambda h: h["members"][1].update(report=[]),
}


@pytest.mark.parametrize("name", HEADERS)
def test_headers_of_families(name, family_file):
    header, outer, data = parts(family_file)
    HEADERS[name](header)
    write(family_file, header, outer, data)
    refused(family_file, tc.MasterFamily)


@pytest.mark.parametrize(
    "name", ["0.rates", "1.basis", "0.amplitudes", "1.decay", "0.stderr_times", "1.stderr", "0.damping"]
)
def test_tensors_of_families(name, family_file):
    header, _, _ = parts(family_file)
    good = load_file(family_file)
    text = {"torchchain": json.dumps(header)}
    for bad in (
        torch.full_like(good[name], torch.nan),
        torch.zeros(7),
        torch.zeros(2, 2, 2, 2),
        torch.zeros_like(good[name]).half(),
    ):
        save_file({**good, name: bad}, family_file, metadata=text)
        refused(family_file, tc.MasterFamily)
    save_file({k: v for k, v in good.items() if k != name}, family_file, metadata=text)
    refused(family_file, tc.MasterFamily, "hold the tensors")
    save_file({**good, f"7{name}": good[name].clone()}, family_file, metadata=text)
    refused(family_file, tc.MasterFamily)


SPOILS = {
    "half": lambda raw: raw[: len(raw) // 2],
    "all but eight bytes": lambda raw: raw[:-8],
    "more": lambda raw: raw + b"more",
    "its length": lambda raw: raw[:8],
    "nothing": lambda raw: b"",
    "2^63": lambda raw: struct.pack("<Q", 2**63) + raw[8:],
    "2^64 - 1": lambda raw: struct.pack("<Q", 2**64 - 1) + raw[8:],
    "2^31": lambda raw: struct.pack("<Q", 2**31) + raw[8:],
    "zeros": lambda raw: bytes(4096),
    "a zip file": lambda raw: b"PK\x03\x04" + bytes(100),
    "a picture": lambda raw: b"\x89PNG\r\n\x1a\n" + bytes(100),
    "netCDF": lambda raw: b"\x89HDF\r\n\x1a\n" + bytes(100),
    "text": lambda raw: b"n_particles = 4\n",
    "other letters": lambda raw: raw[:40] + b"\xff\xfe\xfd" + raw[43:],
}


@pytest.mark.parametrize("name", SPOILS)
def test_truncated_and_foreign_files(name, model_file, family_file, run):
    for path, reader in ((model_file, tc.MasterEquation), (family_file, tc.MasterFamily)):
        path.write_bytes(SPOILS[name](path.read_bytes()))
        refused(path, reader)
    for arguments in (("predict", model_file, "--out", "out"), ("plan", *SMALL[:-2], "--artifact", model_file)):
        status, output, errors = run(*arguments)
        assert (status, output, errors.count("\n")) == (2, "", 1)
        assert "must be a master equation saved by torchchain" in errors
    assert not os.path.exists("out")


@pytest.mark.parametrize("reader", [tc.MasterEquation, tc.MasterFamily])
def test_a_hundred_thousand_tensors(reader, model_file, family_file):
    path = model_file if reader is tc.MasterEquation else family_file
    header, outer, data = parts(path)
    some = {"dtype": "F64", "shape": [0], "data_offsets": [len(data), len(data)]}
    write(path, header, {**outer, **{f"t{i}": some for i in range(100_000)}}, data)
    refused(path, reader, "hold the tensors")


def test_one_kind_of_file_is_not_the_other(model_file, family_file):
    refused(family_file, tc.MasterEquation, "carry the format torchchain-master-equation")
    refused(model_file, tc.MasterFamily, "carry the format torchchain-master-family")


@pytest.mark.parametrize("name", ["half", "nothing", "2^63", "a zip file", "text"])
def test_a_family_of_broken_files(name, model_file, run, tmp_path):
    good = model_file.read_bytes()
    (tmp_path / "broken").write_bytes(SPOILS[name](good))
    (tmp_path / "empty").mkdir()
    for models, message in (
        (("broken",), "file broken must be a master equation saved by torchchain"),
        ((model_file, "broken"), "file broken must be a master equation saved by torchchain"),
        ((model_file, model_file), "members must have different strengths"),
        (("nothing",), "file nothing must be a readable file"),
        (("empty",), "file empty must be a file"),
        ((), "models"),
    ):
        status, output, errors = run("family", *models, "--out", "out")
        assert (status, output, errors.count("\n")) == (2, "", 1)
        assert message in errors
    assert sorted(os.listdir(tmp_path)) == ["broken", "empty", "model.safetensors"]


# netCDF


DATASETS = {
    "nothing": lambda d: xarray.Dataset(),
    "no energy": lambda d: d.drop_vars("band_energy"),
    "no errors": lambda d: d.drop_vars("band_energy_stderr"),
    "no blocks": lambda d: d.drop_vars("block_count"),
    "half of the averages": lambda d: d.drop_vars("block_long_time"),
    "no scene": lambda d: d.assign_attrs(scene="") if d.attrs.pop("scene") else None,
    "scene without attribute": lambda d: d.drop_attrs(deep=False),
    "scene of words": lambda d: d.assign_attrs(scene="n_bands = 'x'"),
    "scene of code": lambda d: d.assign_attrs(scene=CODE),
    "other bands": lambda d: d.assign_attrs(scene=d.attrs["scene"].replace("n_bands = 4", "n_bands = 2")),
    "other times": lambda d: d.isel(time=slice(0, 5)),
    "moved times": lambda d: d.assign_coords(time=d["time"] + 1),
    "fewer sources": lambda d: d.isel(source=[0, 1]),
    "not a number": lambda d: d.assign(band_energy=d["band_energy"] * np.nan),
    "infinite": lambda d: d.assign(block_band_energy=d["block_band_energy"] + np.inf),
    "negative errors": lambda d: d.assign(band_energy_stderr=d["band_energy_stderr"] - 1),
    "errors that are no number": lambda d: d.assign(band_energy_stderr=d["band_energy_stderr"] * np.nan),
    "text": lambda d: d.assign(long_time=d["long_time"].astype(str)),
    "integers": lambda d: d.assign(band_energy=d["band_energy"].astype(int)),
    "complex": lambda d: d.assign(band_energy=d["band_energy"] * 1j),
    "no realizations": lambda d: d.assign(block_count=d["block_count"] * 0),
    "half realizations": lambda d: d.assign(block_count=d["block_count"] * 0.5),
    "masses in words": lambda d: d.assign_attrs(mass_mean="heavy"),
    "masses that are no number": lambda d: d.assign_attrs(mass_sd=np.nan),
}


@pytest.mark.parametrize("name", DATASETS)
def test_datasets_that_are_no_transfer(name, transfer):
    data = DATASETS[name](transfer.to_dataset())
    with Taken() as taken, pytest.raises((FieldError, FieldTypeError)) as caught:
        tc.BandTransfer.from_dataset(data)
    assert "\n" not in str(caught.value)
    assert taken.largest < LITTLE


def test_a_dataset_that_is_one(transfer, tmp_path):
    transfer.to_dataset().to_netcdf(tmp_path / "transfer.nc", engine="h5netcdf")
    with xarray.open_dataset(tmp_path / "transfer.nc", engine="h5netcdf") as data:
        again = tc.BandTransfer.from_dataset(data)
    assert torch.equal(again.mean, transfer.mean)
    assert again.block_counts == transfer.block_counts


# A folder that is to be run again


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The folder of a small run."""
    out = tmp_path_factory.mktemp("done") / "out"
    assert cli.main(["simulate", *SMALL, "--observables", "center", "--out", str(out)]) == 0
    return out


RECORD = (
    "arguments",
    "resolved",
    "files",
    "versions",
    "device",
    "config_sha256",
    "machine",
    "git_revision",
    "seed",
    "threads",
    "working_directory",
)


@pytest.mark.parametrize("field", RECORD)
def test_hostile_records(field, done, run, tmp_path):
    """A record that says something odd makes no traceback."""
    folder = tmp_path / "copy"
    shutil.copytree(done, folder)
    good = json.loads((folder / "run.json").read_text())
    for value in (
        None,
        "x",
        -1,
        1e300,
        [],
        ["simulate"],
        [None],
        {},
        {"method": 3},
        {"method": "modes", "options": [1]},
        "missing",
    ):
        record = copy.deepcopy(good)
        record[field] = value
        if value == "missing":
            del record[field]
        (folder / "run.json").write_text(json.dumps(record))
        status, output, errors = run("rerun", folder)
        assert status in (0, 1, 2)
        assert "Traceback" not in output + errors
        assert errors.count("\n") == (status == 2), (value, errors)
        assert sorted(os.listdir(tmp_path)) == ["copy"]


@pytest.mark.parametrize("name", ["run.json", "config.toml", "results.nc"])
def test_broken_files_of_a_run(name, done, run, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(done, folder)
    raw = (folder / name).read_bytes()
    for content in (
        b"",
        raw[: len(raw) // 2],
        b"\xff\xfe",
        bytes(1000),
        b"[" * 10**5,
        b"{}",
        b"null",
        struct.pack("<Q", 2**63) + raw[8:],
        None,
    ):
        (folder / name).unlink(missing_ok=True)
        if content is not None:
            (folder / name).write_bytes(content)
        status, output, errors = run("rerun", folder)
        assert (status, errors.count("\n")) == (2, 1), (content and content[:10], output, errors)
        assert sorted(os.listdir(tmp_path)) == ["copy"]
