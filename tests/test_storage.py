"""Model folders: the same predictions in a new process, and nothing lost on the way."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from conftest import files_of
from dfsm.config.fit import load_config
from dfsm.core import bundle
from dfsm.core.version import __version__
from dfsm.data.readers import read
from dfsm.errors import DfsmError, DfsmWarning
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.corrective.perceptron import MLP
from dfsm.fitting.corrective.rbf import RBF
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV
from dfsm.fitting.settings import FitSettings
from dfsm.models import model_folder
from dfsm.models.model_folder import load, load_all, save
from dfsm.models.signals import Azimuth
from dfsm.simulation.simulate import simulate

KINDS = {
    "rbf": RBF(samples=12),
    "gp": GP(samples=12),
    "mlp": MLP(hidden=(4,), iterations=60),
    "none": NoCorrection(),
}

# Run here and in a new process: every bit of what a model predicts, as hexadecimal.
PREDICT = """
import sys, json
import numpy as np
from dfsm.data.readers import read
from dfsm.simulation.simulate import simulate

def predictions(models, run):
    found = {}
    for name, model in models.items():
        rng = np.random.default_rng(0)
        inputs = rng.normal(size=(7, len(model.signals.inputs)))
        x, u, w, p = model.split(inputs)
        end = simulate(model, run, start=1.0, stop=3.0).trajectory.values
        for what, values in (
            ("derivative", model.derivative(x, u, w, p)),
            ("output", model.output(x, u, w, p)),
            ("rollout", end),
        ):
            found[f"{name} {what}"] = np.asarray(values).tobytes().hex()
    return found
"""
NEW_PROCESS = """
from dfsm.models.model_folder import load_all
run = read(sys.argv[1])
print(json.dumps({p: predictions(load_all(p), run) for p in sys.argv[2:]}))
"""
exec(PREDICT)


@pytest.fixture(scope="module")
def runs(folder):
    return load_config(folder / "config.yaml")[1]


@pytest.fixture(scope="module")
def choices(folder) -> FitSettings:
    return load_config(folder / "config.yaml")[0].fit_settings()


@pytest.fixture(scope="module")
def models(runs, choices, tmp_path_factory):
    """Fitted and saved models of every kind: ``{kind: (FitResult, folder)}``."""
    base = tmp_path_factory.mktemp("models")
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        for kind, corrective in KINDS.items():
            # A nonlinear-only model of one kind will do: the fits are what takes time here.
            chosen = replace(choices, corrective=corrective, gate=0.0, nonlinear_only=kind == "rbf")
            if kind == "none":
                chosen = replace(chosen, linear=LPV(schedule="w", points=3))
            result = fit(runs, chosen)
            save(result.model, base / kind, result.nonlinear)
            found[kind] = (result, base / kind)
    return found


def test_predictions_are_bit_identical_in_a_new_process(models, folder):
    path = folder / "test" / "d.outb"
    code = PREDICT + NEW_PROCESS
    done = subprocess.run(
        [sys.executable, "-c", code, path, *(p for _, p in models.values())],
        capture_output=True,
        text=True,
        check=True,
    )
    there = json.loads(done.stdout)
    run = read(path)
    for kind, (result, saved) in models.items():
        named = {"multi-fidelity": result.model, "nonlinear-only": result.nonlinear}
        here = predictions({k: m for k, m in named.items() if m is not None}, run)  # noqa: F821
        assert there[str(saved)] == here, kind
        assert (result.model.e is None) == (kind == "none")
        assert len(set(here.values())) == len(here)


def test_load_all_returns_what_was_saved(models):
    assert list(load_all(models["rbf"][1])) == ["multi-fidelity", "nonlinear-only"]
    assert list(load_all(models["none"][1])) == ["multi-fidelity"]
    nonlinear = load_all(models["rbf"][1])["nonlinear-only"]
    assert not np.asarray(nonlinear.f.coefficients).any()
    assert load(models["rbf"][1]).f.coefficients.any()


def test_what_is_no_array_comes_back_too(models, tmp_path):
    result, path = models["rbf"]
    loaded = load(path)
    assert loaded.signals == result.model.signals
    assert loaded.corrected == result.model.corrected
    assert loaded.corrected_outputs == result.model.corrected_outputs
    assert load(models["none"][1]).f.schedule == models["none"][0].model.f.schedule == 1
    assert loaded.summary() == result.model.summary()
    # Saved again, it is the same folder.
    save(loaded, tmp_path / "again", load_all(path)["nonlinear-only"])
    assert files_of(tmp_path / "again") == files_of(path)


def test_the_manifest_is_readable_and_complete(models, runs, choices):
    text = (models["rbf"][1] / "manifest.json").read_text(encoding="utf-8")
    assert text.count("\n") > 50
    manifest = json.loads(text)
    assert manifest["format"] == model_folder.FORMAT
    assert manifest["dfsm"] == __version__
    signals = manifest["signals"]
    assert [(c["name"], c["unit"]) for c in signals["states"]] == [("q", "m"), ("q_dot", "m/s")]
    assert [(c["name"], c["unit"]) for c in signals["outputs"]] == [("y", "kN"), ("z", "m")]
    record = manifest["provenance"]
    assert record["settings"]["seed"] == choices.seed
    assert record["settings"]["corrective"]["samples"] == 12
    assert len(record["data"]) == len(runs)
    names = ["q", "u", "w", "y", "z"]
    used = {r.select(names).digest for r in runs}
    assert {d["sha256"] for d in record["data"]} == used
    assert "NaN" not in text


def test_nothing_in_the_folder_is_code(models):
    for _, path in models.values():
        assert sorted(files_of(path)) == ["manifest.json", "model.safetensors"]
        tensors = load_file(path / "model.safetensors")
        assert {t.dtype for t in tensors.values()} == {np.dtype(np.float64)}
        for raw in files_of(path).values():
            assert b"pickle" not in raw
            assert not re.match(rb"\x80[\x02-\x05]|PK", raw)  # a pickle, a zip of pickles


# -- replacing ----------------------------------------------------------------------------------


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), None])
@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("place", ["write_bytes", "json_bytes", "rename"])
def test_a_failed_save_keeps_the_old_model(models, tmp_path, monkeypatch, place, existing, failure):
    path = tmp_path / "m"
    if existing:
        shutil.copytree(models["none"][1], path)
    before = files_of(tmp_path)

    def fail(*_, **__):
        raise failure or KeyboardInterrupt

    if place == "rename":
        rename = Path.rename

        def once(self, target):
            # The new folder does not get into place; the old one may go back.
            if Path(target) == path and self.name != "replaced":
                fail()
            return rename(self, target)

        monkeypatch.setattr("dfsm.core.exchange.swap", lambda *_: False)  # as on other systems
        monkeypatch.setattr(Path, "rename", once)
    elif place == "write_bytes":
        monkeypatch.setattr(Path, place, fail)
    else:
        monkeypatch.setattr(bundle, place, fail)
    with pytest.raises(DfsmError if failure else KeyboardInterrupt) as caught:
        save(models["rbf"][0].model, path)
    if failure:
        assert "could not be written (No space left on device)" in str(caught.value)
    assert files_of(tmp_path) == before
    assert [p.name for p in tmp_path.iterdir()] == (["m"] if existing else [])
    if existing:
        assert load(path).e is None


def test_a_model_replaces_a_model_and_nothing_else(models, tmp_path):
    path = tmp_path / "m"
    path.mkdir()
    save(models["none"][0].model, path)
    save(models["rbf"][0].model, path)
    assert load(path).e is not None
    assert [p.name for p in tmp_path.iterdir()] == ["m"]
    (path / "notes.txt").write_text("mine")
    with pytest.raises(DfsmError, match="is not a folder that dfsm wrote"):
        save(models["none"][0].model, path)
    # Browsers' and packagers' manifests have that name too.
    foreign = tmp_path / "web"
    foreign.mkdir()
    (foreign / "manifest.json").write_text("{}")
    with pytest.raises(DfsmError, match="is not a folder that dfsm wrote"):
        save(models["none"][0].model, foreign)
    assert (foreign / "manifest.json").read_text() == "{}"


@pytest.mark.skipif(os.name == "nt", reason="permissions work differently there")
@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_permissions_follow_the_umask(models, tmp_path, umask):
    old = os.umask(umask)
    try:
        save(models["none"][0].model, tmp_path / "m")
    finally:
        os.umask(old)
    assert stat.S_IMODE((tmp_path / "m").stat().st_mode) == 0o777 & ~umask
    for file in (tmp_path / "m").iterdir():
        assert stat.S_IMODE(file.stat().st_mode) == 0o666 & ~umask


# -- damage -------------------------------------------------------------------------------------


@pytest.fixture
def model(models, tmp_path):
    """Copy of a model folder to damage."""
    return shutil.copytree(models["none"][1], tmp_path / "m")


def complaint(path) -> str:
    with pytest.raises(DfsmError) as caught:
        load(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def paths(node, at=()):
    yield at
    items = (
        node.items()
        if isinstance(node, dict)
        else (enumerate(node) if isinstance(node, list) else ())
    )
    for key, child in items:
        yield from paths(child, (*at, key))


def test_any_change_to_the_manifest_is_told(model):
    file = model / "manifest.json"
    whole = file.read_text(encoding="utf-8")
    places = [p for p in paths(json.loads(whole)) if p and p != ("format",)]
    assert len(places) > 50
    for place in places:
        for value in (None, [], "x", 99, {}):
            manifest = json.loads(whole)
            node = manifest
            for key in place[:-1]:
                node = node[key]
            if node[place[-1]] == value:
                continue
            node[place[-1]] = value
            file.write_text(json.dumps(manifest), encoding="utf-8")
            assert "is damaged: manifest.json is not as it was written" in complaint(model), place


def test_layout_of_the_manifest_does_not_matter(model):
    file = model / "manifest.json"
    manifest = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(dict(reversed(manifest.items()))), encoding="utf-8")
    assert load(model).signals.names("controls") == ("u",)


def test_a_manifest_whose_checksum_holds_but_whose_content_does_not(model):
    file = model / "manifest.json"
    manifest = json.loads(file.read_text(encoding="utf-8"))
    for key, value in (("models", []), ("signals", {}), ("models", {"multi-fidelity": {}})):
        forged = manifest | {key: value}
        forged["checksum"] = bundle.checksum(forged)
        file.write_text(json.dumps(forged), encoding="utf-8")
        assert "lacks or garbles" in complaint(model)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "manifest.json cannot be read"),
        (b"{", "manifest.json cannot be read"),
        (b"\xff\xfe", "manifest.json cannot be read"),
        (b"[" * 100_000, "manifest.json cannot be read"),
        (b"[]", "manifest.json states no format number"),
        (b"{}", "manifest.json states no format number"),
        (b'{"format": "1"}', "manifest.json states no format number"),
    ],
)
def test_a_garbled_manifest_is_told(model, content, match):
    (model / "manifest.json").write_bytes(content)
    assert match in complaint(model)


def test_a_newer_format_is_told_with_the_remedy(model):
    file = model / "manifest.json"
    manifest = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(manifest | {"format": model_folder.FORMAT + 1, "new": []}))
    said = complaint(model)
    assert f"has format {model_folder.FORMAT + 1}, this dfsm {__version__} reads up to" in said
    assert said.endswith("upgrade with pip install -U dfsm")


def test_damaged_tensors_are_told(model):
    file = model / "model.safetensors"
    whole = file.read_bytes()
    for at in range(0, len(whole), max(1, len(whole) // 25)):
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
        assert "model.safetensors is not the file that manifest.json was written for" in complaint(
            model
        )
    file.write_bytes(whole[:-1])
    assert "is not the file" in complaint(model)
    file.unlink()
    assert "model.safetensors cannot be read (No such file or directory)" in complaint(model)


def test_what_is_no_model_folder(tmp_path):
    assert "is missing; a model folder" in complaint(tmp_path / "none")
    assert "holds no manifest.json, so it is not a model folder" in complaint(tmp_path)
    (tmp_path / "file").write_text("")
    assert "is a file; a model folder" in complaint(tmp_path / "file")


# -- determinism --------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rbf", "mlp"])
def test_the_same_data_and_seed_give_the_same_bytes(models, runs, choices, tmp_path, kind):
    def tensors(data, seed, name):
        chosen = replace(choices, corrective=KINDS[kind], gate=0.0, seed=seed)
        result = fit(data, replace(chosen, nonlinear_only=kind == "rbf"))
        save(result.model, tmp_path / name, result.nonlinear)
        return hashlib.sha256((tmp_path / name / "model.safetensors").read_bytes()).hexdigest()

    first = hashlib.sha256((models[kind][1] / "model.safetensors").read_bytes()).hexdigest()
    assert tensors(list(reversed(runs)), choices.seed, "shuffled") == first
    assert tensors(runs, choices.seed + 1, "other") != first


def test_an_azimuth_survives(models, tmp_path):
    result, _ = models["none"]
    azimuth = Azimuth(speed="q", angle="psi", blades=2)
    changed = replace(result.model, signals=replace(result.model.signals, azimuth=azimuth))
    save(changed, tmp_path / "m")
    assert load(tmp_path / "m").signals.azimuth == azimuth


def test_a_loaded_model_simulates_without_the_file_it_came_from(models, folder, tmp_path):
    path = shutil.copytree(models["rbf"][1], tmp_path / "m")
    model = load(path)
    shutil.rmtree(path)
    assert simulate(model, read(folder / "test" / "d.outb"), start=1.0, stop=3.0).outside <= 1
