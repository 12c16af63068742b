"""What is stored: digests tell damage, names stay names, damaged inputs are one sentence."""

from __future__ import annotations

import csv
import hashlib
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from safetensors.numpy import load_file, save

from benchmarks.fuzz import check
from benchmarks.fuzz_samples import samples
from conftest import CONFIG, write_config
from dfsm.config.fit import parse_config
from dfsm.core.bundle import MANIFEST, signed
from dfsm.core.files import json_bytes
from dfsm.data.readers import read
from dfsm.data.readers.tables import read_table, write_table
from dfsm.data.trajectory import Channel, Trajectory
from dfsm.errors import DfsmError
from dfsm.models.model_folder import load_all
from dfsm.models.model_folder import save as save_model
from dfsm.numerics.fatigue import damage_equivalent_load

SAVED = Path(__file__).parent / "data" / "saved_by_0.1"


def run(*names: str, name: str = "r") -> Trajectory:
    time = 0.1 * np.arange(30)
    values = np.stack([np.round(np.sin(time + k), 3) for k in range(len(names))], axis=1)
    return Trajectory(time, values, tuple(Channel(n, "m", 0.001) for n in names), name=name)


# -- tables ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("packed", [False, True])
def test_any_flipped_bit_in_a_parquet_file_is_told_or_changes_nothing(tmp_path, packed):
    whole, path = run("a", "b"), tmp_path / "r.parquet"
    write_table(whole, path, packed=packed)
    raw, expected = path.read_bytes(), read_table(path)
    told = 0
    for bit in np.random.default_rng(0).choice(8 * len(raw), 150, replace=False):
        damaged = bytearray(raw)
        damaged[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(damaged)
        try:
            found = read_table(path)
        except DfsmError:
            told += 1
            continue
        assert found.digest == expected.digest, bit
        assert (found.channels, found.name) == (expected.channels, expected.name), bit
    assert told > 75


def test_names_that_a_spreadsheet_would_run(tmp_path):
    names = ("=cmd|' /C calc'!A0", "+a", "-b", "@c", "'=d", "'e", "f")
    write_table(run(*names), tmp_path / "r.csv")
    with (tmp_path / "r.csv").open(newline="") as stream:
        header = next(csv.reader(stream))
    assert not any(cell.startswith(("=", "+", "-", "@")) for cell in header)
    assert read(tmp_path / "r.csv").names == names


def test_the_name_of_a_run_is_no_path(tmp_path):
    for name in ("../r", "a/b", "a\\b", ".."):
        with pytest.raises(DfsmError, match="a name cannot hold"):
            write_table(run("a", name=name), tmp_path / "r.parquet")
        # As another program may write it.
        table = pa.Table.from_pandas(run("a").to_pandas())
        table = table.replace_schema_metadata({**table.schema.metadata, "dfsm.name": name})
        pq.write_table(table, tmp_path / "r.parquet")
        with pytest.raises(DfsmError, match="a name cannot hold"):
            read(tmp_path / "r.parquet")


def test_inputs_of_one_stem_are_refused_before_the_work(here, dfsm, damaged):
    for file in (Path("one/R.parquet"), Path("two/r.parquet")):
        file.parent.mkdir()
        write_table(run("a", name="called otherwise"), file)
    Path("f.bts").write_bytes(damaged[1]["field.bts"].raw)
    said = dfsm("wind", "f.bts", "one/R.parquet", "two/r.parquet", "--radius", "3", "-o", "out")
    assert said.sentence == (
        "one/R.parquet and two/r.parquet would both be written to out/r.parquet: rename one of "
        "them, or write them to different folders"
    )
    assert not Path("out").exists()


def test_a_load_history_with_holes_is_refused():
    values = np.sin(np.arange(50.0))
    values[[7, 9]] = np.nan, np.inf
    with pytest.raises(DfsmError, match="2 NaN or infinite samples, the first is number 8"):
        damage_equivalent_load(values, 5.0, 4.0)
    with pytest.raises(DfsmError, match="has no samples"):
        damage_equivalent_load(np.empty(0), 5.0, 4.0)
    with pytest.raises(DfsmError, match="lasts 0 s"):
        damage_equivalent_load(np.sin(np.arange(50.0)), 0.0, 4.0)


# -- folders --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    models = load_all(SAVED / "model")
    path = tmp_path_factory.mktemp("stored") / "m"
    save_model(models["multi-fidelity"], path, models["nonlinear-only"])
    return path


def forged(model: Path, change) -> Path:
    """The folder with another manifest or other arrays, whose digests hold."""
    manifest = json.loads((model / MANIFEST).read_text())
    tensors = load_file(model / "model.safetensors")
    change(manifest, tensors)
    raw = save(tensors)
    manifest["sha256"] = hashlib.sha256(raw).hexdigest()
    target = model.with_name("forged")
    target.mkdir(exist_ok=True)
    (target / "model.safetensors").write_bytes(raw)
    (target / MANIFEST).write_bytes(json_bytes(signed(manifest)))
    return target


MAIN = "multi-fidelity"


def part(key, value):
    def change(manifest, _):
        manifest["models"][MAIN][key] = value

    return change


def shape(name, cut):
    def change(_, tensors):
        tensors[f"{MAIN}/{name}"] = np.ascontiguousarray(cut(tensors[f"{MAIN}/{name}"]))

    return change


def one_more_state(manifest, _):
    manifest["signals"]["states"].append({"name": "q3", "unit": ""})


FORGERIES = {
    "corrected": part("corrected", [10**9]),
    "schedule": part("f", {"schedule": 99, "known": []}),
    "known": part("f", {"schedule": 1, "known": [[0, 10**6]]}),
    "layers": part("e", {"kind": "perceptron", "layers": 10**9}),
    "latents": part("latents", -1),
    "no linear fit": part("f", None),
    "states": one_more_state,
    "coefficients": shape("f/coefficients", lambda a: a[:, :, :-1]),
    "one row": shape("f/offsets", lambda a: a[:, :1]),
    "a scalar": shape("region/low", lambda a: a[0]),
    "the grid": shape("f/grid", lambda a: a[::-1]),
    "single precision": shape("region/high", lambda a: a.astype(np.float32)),
    "history": lambda manifest, _: manifest["provenance"].update(rows=[1]),
    "blades": lambda manifest, _: manifest["signals"].update(
        azimuth={"speed": "q_dot", "angle": "psi", "blades": 10**9, "rings": [10.0]}
    ),
}


@pytest.mark.parametrize("change", FORGERIES.values(), ids=FORGERIES)
def test_a_manifest_that_does_not_fit_its_signals(model, change):
    assert len(load_all(forged(model, lambda *_: None))) == 2
    with pytest.raises(DfsmError, match=r"is damaged: its manifest.json lacks or garbles") as error:
        load_all(forged(model, change))
    assert "\n" not in str(error.value)


# -- configurations -------------------------------------------------------------------------------

LAUGHS = "a0: &a0 [x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 9)
)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("data: {start: 2001-13-45, train: [a]}\nsignals: {states: [q]}", "'2001-13-45'"),
        (f"seed: {'9' * 5000}", "line 1: 9{24} is beyond 9.22e[+]18"),
        ("seed: 10000000000000000000", "is beyond"),
        (LAUGHS, "more than 20000 values, aliases counted as what they stand for"),
        ("a: &a\n  <<: *a\n", "nested too deeply"),
        ("a: {<<: 5}", "'<<' is followed by no keys"),
        ("a: " + "{b: " * 60, "line 1: nested too deeply for a configuration"),
        ("? {a: b}\n: c", "line 1: a key is dict, expected a name"),
        ("2001-01-01: c\n", "key 'data' is missing"),
        ("true: c\n", "line 1: a key is bool"),
        ("a: !!set {x}", "not valid YAML .could not determine"),
        ("a: !!float x", "'x' is no number"),
        ("a: 1\n---\nb: 2\n", "not valid YAML"),
        ("# " + "x" * 1_000_001, "1000003 characters are too many"),
    ],
)
def test_yaml_beyond_a_configuration_is_refused_at_once(tmp_path, text, match):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(DfsmError, match=match) as error:
        parse_config(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_a_configuration_of_too_many_values(tmp_path, monkeypatch):
    monkeypatch.setattr("dfsm.config.yaml_text.MOST_VALUES", 100)
    (tmp_path / "c.yaml").write_text("a: [" + "1, " * 200 + "]")
    with pytest.raises(DfsmError, match="line 1: more than 100 values"):
        parse_config(tmp_path / "c.yaml")


def test_merge_keys_and_aliases_are_read(tmp_path):
    plain = parse_config(write_config(tmp_path / "plain.yaml", CONFIG | {"seed": 31}))
    text = (tmp_path / "plain.yaml").read_text().replace("seed: 31", "seed: 0x1F")
    text = text.replace("corrective:", "corrective: &c\n  <<: {kind: mlp, samples: 7}", 1)
    (tmp_path / "merged.yaml").write_text(text)
    assert "&c" in text
    assert repr(parse_config(tmp_path / "merged.yaml")) == repr(plain)


# -- damage of every kind -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def damaged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("damaged")
    return folder, samples(folder)


KINDS = {
    **dict.fromkeys(("run.csv", "run.parquet", "packed.parquet", "run.out", "run.outb"), 60),
    **dict.fromkeys(("gust.wnd", "run.%25", "run.sel", "run.mat"), 60),
    **{"deck.IN": 40, "tune.yaml": 20, "sweep.yaml": 20},
    **dict.fromkeys(("run.lvm", "toa5.csv", "commas.csv"), 40),
    **dict.fromkeys(("field.bts", "rotor.txt", "times.json", "intervals.json", "result.json"), 60),
    **{"config.yaml": 12, "problem.yaml": 30},
    **{"model manifest": 20, "model arrays": 10, "model shapes": 12},
    **{"solution manifest": 30, "solution arrays": 10, "solution shapes": 15},
}


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_inputs_are_a_sentence_or_what_they_were(damaged, kind):
    folder, made = damaged
    assert set(made) == set(KINDS)
    faults = {seed: check(made[kind], seed, folder) for seed in range(KINDS[kind])}
    assert not {seed: what for seed, what in faults.items() if what}
