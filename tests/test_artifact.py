"""The file of a master equation: what is written is read back, what is wrong is named."""

import copy
import json
import os
import struct
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import torchchain as tc
from torchchain.checks import FieldError
from torchchain.master import AdamReport, Calibration, Report, Rung, Selection
from torchchain.master.memory import MemoryModel

B = 4
EYE = torch.eye(B, dtype=torch.float64)


def markov():
    rates = 0.1 * torch.rand(B, B, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    rates = rates - torch.diag(rates.sum(-1))
    return tc.RateModel(rates, 0.5 * EYE + 0.1, torch.full((B,), 0.01))


def memory():
    part = (EYE - 0.2) / 2
    tensors = (
        torch.stack([part, part, 0.1 * EYE - 0.025]),
        torch.tensor([0.3]),
        torch.tensor([0.1]),
        torch.tensor([0.7]),
    )
    return MemoryModel(-EYE, torch.full((B, B), 0.2, dtype=torch.float64), *tensors)


SCENE = tc.Scene(
    n_particles=32, n_bands=B, seed=2**64 - 1, times=[0.0, 0.1, 0.7], tolerance=0.1,
    stiffness_disorder=tc.Disorder("gamma", 0.1), excitation=tc.StandingWave((1, 7, 9, 16), 0.1, "cos"),
)  # fmt: skip


def master(model, window=(0.5, 2.0)):
    fit = AdamReport(True, 7, 1.25e-3, 1.5, "exact", 10.0)
    report = Report(fit, Selection("säkular\nzwei", tried=(Rung("memory", (1, 2), 0.25),)), horizon=12.5)
    return tc.MasterEquation(model, Calibration("adam", "basis_matrix", window, SCENE, report))


@pytest.mark.parametrize("window", [(0.5, 2.0), None])
@pytest.mark.parametrize("model", [markov, memory])
def test_save_load_save_is_byte_identical(model, window, tmp_path):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    original = master(model(), window)
    original.save(first)
    again = tc.MasterEquation.load(first)
    again.save(second)
    assert first.read_bytes() == second.read_bytes()
    assert type(again.model) is type(original.model)
    for name, tensor in original.model.tensors().items():
        assert torch.equal(again.model.tensors()[name], tensor)
    assert torch.equal(again.solve(EYE, [0.0, 3.0]), original.solve(EYE, [0.0, 3.0]))
    ours, theirs = original.calibration, again.calibration
    assert (theirs.method, theirs.model, theirs.window, theirs.report) == (
        ours.method,
        ours.model,
        ours.window,
        ours.report,
    )
    assert theirs.scene.to_dict() == ours.scene.to_dict()


def test_single_precision_is_kept(tmp_path):
    path = tmp_path / "model.safetensors"
    master(markov().float()).save(path)
    assert tc.MasterEquation.load(path).rates.dtype == torch.float32


def test_a_file_on_the_way_replaces_only_when_whole(tmp_path, monkeypatch):
    path = tmp_path / "model.safetensors"
    master(markov()).save(path)
    before = path.read_bytes()

    def dies(*arguments, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchchain.master.file.save_file", dies)
    with pytest.raises(KeyboardInterrupt):
        master(memory()).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["model.safetensors"]


def test_the_header_tells_what_a_reader_needs(tmp_path):
    path = tmp_path / "model.safetensors"
    master(markov()).save(path)
    header = parts(path)[0]
    assert header["format"] == "torchchain-master-equation"
    assert header["format_version"] == 3
    assert (header["strength"], header["n_bands"], header["window"]) == (0.3, B, [0.5, 2.0])
    assert header["scene"]["seed"] == 2**64 - 1
    assert {"torchchain", "torch", "numpy", "scipy", "torchdiffeq"} <= set(header["versions"])
    assert "source" in header["conventions"]["axes"]


def parts(path):
    """Header of torchchain, header of safetensors, data."""
    raw = path.read_bytes()
    (size,) = struct.unpack("<Q", raw[:8])
    outer = json.loads(raw[8 : 8 + size])
    return json.loads(outer["__metadata__"]["torchchain"]), outer, raw[8 + size :]


def write(path, header, outer, data, text=None):
    outer = {**outer, "__metadata__": {"torchchain": json.dumps(header) if text is None else text}}
    encoded = json.dumps(outer).encode()
    encoded += b" " * (-len(encoded) % 8)
    path.write_bytes(struct.pack("<Q", len(encoded)) + encoded + data)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.safetensors"
    master(markov()).save(path)
    return path


def refused(path, match=None):
    with pytest.raises(FieldError, match=match) as caught:
        tc.MasterEquation.load(path)
    assert str(caught.value).startswith(f"file {path} must") or str(caught.value).startswith(f"file {path}: kind must")
    assert "\n" not in str(caught.value)


def test_rewriting_changes_nothing_by_itself(saved):
    header, outer, data = parts(saved)
    write(saved, header, outer, data)
    assert tc.MasterEquation.load(saved).n_bands == B


FIELDS = (
    "conventions", "format", "format_version", "kind", "method", "model", "n_bands", "provenance", "rates_meaning", "report",
    "scene", "strength", "versions", "window",
)  # fmt: skip


@pytest.mark.parametrize("field", FIELDS)
def test_every_field_is_needed_and_of_its_type(field, saved):
    header, outer, data = parts(saved)
    assert set(header) == set(FIELDS)
    without = {name: value for name, value in header.items() if name != field}
    write(saved, without, outer, data)
    refused(saved, field.replace("_", "[_ ]"))
    right = type(header[field])
    for wrong in (None, True, -7, 0.123, 10**400, "other", [], [1], {}, {"a": 1}, [None, 3], [2, 1], [float("nan"), 1]):
        free = field == "versions" and isinstance(wrong, dict)
        free |= field == "report" and wrong == {}
        free |= field in ("model", "provenance", "rates_meaning") and isinstance(wrong, str)
        if free or (field == "window" and wrong is None):
            continue
        write(saved, {**header, field: wrong}, outer, data)
        refused(saved, None if isinstance(wrong, right) else field.replace("_", "[_ ]"))


@pytest.mark.parametrize(
    "window", [[0.5], [0.5, 2, 3], [2, 1], [1, 1], [-1, 1], ["a", 1], [True, 2], [0, float("inf")], [[0], [1]]]
)
def test_bad_windows(window, saved):
    header, outer, data = parts(saved)
    write(saved, {**header, "window": window}, outer, data)
    refused(saved, "hold valid fields, got window must be")


@pytest.mark.parametrize("field", SCENE.to_dict())
def test_every_field_of_the_scene_is_checked(field, saved):
    header, outer, data = parts(saved)
    for wrong in (None, "x", [], {"a": 1}, -1, float("nan"), 10**400, [10**400], [[]]):
        if (field, wrong) == ("tolerance", None):
            continue  # what a scene without one says
        scene = {**header["scene"], field: wrong}
        write(saved, {**header, "scene": scene}, outer, data)
        refused(saved, "hold valid fields")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_bands": 2}, "hold .* with 2 bands"),
        ({"n_bands": 0}, "hold .* with 0 bands"),
        ({"strength": 0.2}, "state the strength of its scene, got 0.2"),
        ({"strength": float("nan")}, "state the strength of its scene"),
        ({"format_version": 1}, "have format version 3 .*, got 1"),
        ({"format_version": 2}, "have format version 3 .*, got 2"),
        ({"format_version": 1.5}, "have format version 3"),
        ({"kind": "memory"}, "hold the tensors amplitudes"),
        ({"kind": "torch.nn.Linear"}, "kind must be one of markov, swing_in, memory"),
        ({"conventions": {"axes": "rates[receiver, source]"}}, "follow version 1 of the conventions"),
        ({"conventions": {"version": 2}}, "follow version 1 of the conventions, got 2"),
        ({"format": "torchchain-scene"}, "carry the format torchchain-master-equation"),
    ],
)
def test_headers_that_do_not_fit(change, message, saved):
    header, outer, data = parts(saved)
    write(saved, {**header, **change}, outer, data)
    refused(saved, message)


def test_a_scene_of_other_bands(saved):
    header, outer, data = parts(saved)
    scene = {**header["scene"], "n_bands": 2, "excitation": {"kind": "standing_wave"}}
    write(saved, {**header, "scene": scene}, outer, data)
    refused(saved, "have as many bands in its scene as in its rates, got 2 and 4")


def test_unknown_keys_in_the_scene(saved):
    header, outer, data = parts(saved)
    write(saved, {**header, "scene": {**header["scene"], "code": "import os"}}, outer, data)
    refused(saved, "scene must have only the keys .*, got 'code'")


@pytest.mark.parametrize(
    "text", ["", "{", "null", "3", '"x"', "[]", "[" * 200_000, '{"format": ' * 100_000, '{"a": 1' + "0" * 5000 + "}"]
)
def test_headers_that_are_no_record(text, saved):
    header, outer, data = parts(saved)
    write(saved, header, outer, data, text)
    refused(saved)


def test_no_header_of_ours(tmp_path):
    path = tmp_path / "foreign.safetensors"
    for metadata in (None, {}, {"format": "pt"}):
        save_file({"weight": torch.zeros(3)}, path, metadata=metadata)
        refused(path, "carry the format torchchain-master-equation, got no such header")


@pytest.mark.parametrize(
    "spoil",
    [
        lambda raw: raw[:-8],
        lambda raw: raw[: len(raw) // 2],
        lambda raw: raw[:20],
        lambda raw: raw[:8],
        lambda raw: raw[:3],
        lambda raw: b"",
        lambda raw: raw + b"more",
        lambda raw: struct.pack("<Q", 2**63) + raw[8:],
        lambda raw: struct.pack("<Q", 2**64 - 1) + raw[8:],
        lambda raw: struct.pack("<Q", 0) + raw[8:],
        lambda raw: b"PK\x03\x04" + bytes(200),
        lambda raw: b"\x89HDF\r\n\x1a\n" + bytes(200),
        lambda raw: b"n_particles = 4\n",
        lambda raw: bytes(1000),
        lambda raw: raw[:100] + b"\xff\xfe" + raw[102:],
    ],
)
def test_truncated_and_foreign_files(spoil, saved):
    saved.write_bytes(spoil(saved.read_bytes()))
    refused(saved)


def test_overlapping_and_outside_data(saved):
    header, outer, data = parts(saved)
    for offsets in ([0, 2**40], [2**62, 2**63], [64, 192], [128, 0]):
        spoiled = copy.deepcopy(outer)
        spoiled["rates"]["data_offsets"] = offsets
        write(saved, header, spoiled, data)
        refused(saved)
    spoiled = copy.deepcopy(outer)
    spoiled["rates"]["shape"] = [2**40, 2**40]
    write(saved, header, spoiled, data)
    refused(saved)


def good():
    return {name: tensor.detach().clone() for name, tensor in markov().tensors().items()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rates": torch.zeros(3, 3)}, r"hold rates of shape \(band, band\) with 4 bands, got shape \(3, 3\)"),
        ({"rates": torch.zeros(4)}, "hold rates of shape"),
        ({"rates": torch.zeros(4, 4, 1)}, "hold rates of shape"),
        ({"damping": torch.zeros(5)}, "hold damping of shape"),
        ({"rates": torch.zeros(4, 4, dtype=torch.float16)}, "hold rates as 32 or 64 bit floating point, got F16"),
        ({"rates": torch.zeros(4, 4, dtype=torch.int64)}, "hold rates as 32 or 64 bit floating point, got I64"),
        ({"rates": torch.full((4, 4), torch.nan)}, "hold valid fields, got rates must be finite, got nan"),
        ({"basis": torch.full((4, 4), torch.inf)}, "hold valid fields, got basis must be finite, got inf"),
        ({"basis": 2 * torch.eye(4)}, "hold valid fields, got basis must have row sums of at most 1"),
        ({"damping": -torch.ones(4)}, "hold valid fields, got damping must not be negative"),
        ({"more": torch.zeros(2)}, "hold the tensors basis, damping, rates"),
        ({f"t{i}": torch.zeros(1) for i in range(20_000)}, "hold the tensors basis, damping, rates"),
    ],
)
def test_wrong_tensors(changes, message, saved):
    header, _, _ = parts(saved)
    save_file({**good(), **changes}, saved, metadata={"torchchain": json.dumps(header)})
    refused(saved, message)


@pytest.mark.parametrize("name", ["rates", "basis", "damping"])
def test_missing_tensors(name, saved):
    header, _, _ = parts(saved)
    tensors = good()
    del tensors[name]
    save_file(tensors, saved, metadata={"torchchain": json.dumps(header)})
    refused(saved, "hold the tensors basis, damping, rates")


def test_tensors_of_two_precisions_are_made_one(saved):
    header, _, _ = parts(saved)
    save_file({**good(), "basis": good()["basis"].float()}, saved, metadata={"torchchain": json.dumps(header)})
    assert tc.MasterEquation.load(saved).solve(EYE, [0.0, 1.0]).dtype == torch.float64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"amplitudes": torch.zeros(3, 4, 4)}, "amplitudes must add up to 1 - basis at time 0"),
        ({"amplitudes": torch.zeros(2, 4, 4)}, "amplitudes must have shape"),
        ({"amplitudes": torch.zeros(129, 4, 4)}, "hold amplitudes of shape"),
        ({"decay": -torch.ones(1)}, "decay must not be negative"),
        ({"pair_frequency": torch.ones(2)}, "amplitudes must have shape|pair_frequency"),
        ({"pair_decay": torch.full((1,), torch.nan)}, "pair_decay must be finite"),
    ],
)
def test_wrong_tensors_of_a_memory(changes, message, tmp_path):
    path = tmp_path / "model.safetensors"
    master(memory()).save(path)
    header, _, _ = parts(path)
    tensors = {name: tensor.clone() for name, tensor in memory().tensors().items()}
    save_file({**tensors, **changes}, path, metadata={"torchchain": json.dumps(header)})
    refused(path, message)


def test_places_that_are_no_file(tmp_path):
    refused(tmp_path / "nothing.safetensors", "be a readable file, got No such file")
    refused(tmp_path, "be a file, got a folder or device")
    refused(tmp_path / ("x" * 300), "be a readable file")
    os.mkfifo(tmp_path / "pipe")
    refused(tmp_path / "pipe", "be a file")  # opening it would wait for ever
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    refused(tmp_path / "loop", "be a readable file")
    with pytest.raises(FieldError, match="be a master equation saved by torchchain, got 'embedded null byte'"):
        tc.MasterEquation.load("a\0b")
    with pytest.raises(FieldError, match="be a readable file, got No such file") as caught:
        tc.MasterEquation.load(tmp_path / "two\nlines")
    assert "\n" not in str(caught.value)


def test_a_huge_file_is_not_read(tmp_path):
    path = tmp_path / "huge.safetensors"
    with open(path, "wb") as file:
        file.truncate(2**40)  # sparse
    refused(path, f"be at most {2**28} bytes, got {2**40}")


def test_a_link_is_followed(saved, tmp_path):
    (tmp_path / "link.safetensors").symlink_to(saved)
    assert tc.MasterEquation.load(tmp_path / "link.safetensors").n_bands == B


def test_places_that_cannot_be_written(tmp_path):
    for path in (tmp_path / "nothing" / "x.safetensors", tmp_path / ("x" * 300), "a\0b"):
        with pytest.raises(FieldError, match="must be writable"):
            master(markov()).save(path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(FieldError, match="must be writable"):
        master(markov()).save(tmp_path / "folder")
    assert os.listdir(tmp_path) == ["folder"]


def test_a_report_that_json_cannot_hold(tmp_path):
    spoiled = master(markov())
    spoiled.calibration = replace(
        spoiled.calibration, report=Report(fit=AdamReport(True, 1, np.inf, 1.0, "exact", 0.0))
    )
    with pytest.raises(FieldError, match="report must hold finite numbers"):
        spoiled.save(tmp_path / "x.safetensors")
    assert os.listdir(tmp_path) == []
