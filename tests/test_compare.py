"""Structure choice: who wins, what is kept, what a kill leaves, and what is refused."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML

import dfsm as package
from conftest import changed, files_of, write_config
from dfsm.config.fit import parse_candidates, parse_config
from dfsm.config.template import write_config as write_template
from dfsm.data.derivatives import StateSpec
from dfsm.errors import DfsmError
from dfsm.fitting.corrective import NoCorrection
from dfsm.fitting.corrective.gaussian_process import GP
from dfsm.fitting.fit import fit
from dfsm.fitting.linear import LPV, LTI
from dfsm.fitting.settings import FitSettings
from dfsm.models.model_folder import load
from dfsm.selection.compare import Candidate, compare
from systems import SCHEDULED

LINEAR = Candidate(
    FitSettings(
        states=(StateSpec(name="q", order=2),),
        controls=("u",),
        disturbances=("w",),
        linear=LPV(schedule="w", points=3),
        corrective=NoCorrection(),
        start=1.0,
    )
)


def variant(**settings) -> Candidate:
    return replace(LINEAR, settings=replace(LINEAR.settings, **settings))


@pytest.fixture(scope="module")
def runs():
    """A second-order system whose coefficients vary with w."""
    return SCHEDULED.many(5, [(0, 1), (5, 3)], np.arange(0, 15.01, 0.05))


def declared(**candidates) -> dict:
    """The configuration of `conftest`, linear, with candidates."""
    config = changed("corrective", value={"kind": "none"})
    return config | {"compare": {"hold_out": 0.34, "candidates": candidates}}


def complaint(tmp_path, content) -> str:
    path = write_config(tmp_path / "c.yaml", content)
    with pytest.raises(DfsmError) as caught:
        parse_candidates(path)
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{path}: ")


def wait_for(condition) -> None:
    limit = time.monotonic() + 100
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.01)


def group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


# -- ranking --------------------------------------------------------------------------------------


def test_the_true_structure_comes_first(runs, tmp_path):
    candidates = {
        "first_order": variant(states=(StateSpec(name="q"),)),
        "lti": variant(linear=LTI()),
        "true": LINEAR,
        "broken": variant(outputs=("nope",)),
    }
    found = compare(candidates, runs, tmp_path / "c", jobs=1)
    assert [c.name for c in found.candidates] == ["true", "lti", "first_order", "broken"]
    assert found.states == ("q",)
    assert found.best is found.candidates[0]
    true, lti, *_, broken = found.candidates
    assert true.score is not None
    assert lti.score is not None
    assert true.score == true.outcome.nrmse["q"] < 0.1 < lti.score
    # 3 points × (4 inputs and an offset), or one.
    assert (true.outcome.parameters, lti.outcome.parameters) == (15, 5)
    assert broken.status == "failed"
    assert broken.folder is broken.score is None
    assert "no channel 'nope'" in broken.outcome.message
    # Nobody was trained on what chose.
    assert (len(found.training), len(found.validation)) == (4, 1)
    record = load(tmp_path / "c" / "lti").provenance.record
    assert {d["name"] for d in record["data"]} == set(found.training)
    assert not set(found.training) & set(found.validation)


def test_the_score_is_that_of_validate(runs, tmp_path):
    found = compare({"a": LINEAR, "b": variant(gate=0.5)}, runs[:4], tmp_path / "c", jobs=1)
    held = [r for r in runs if r.name in found.validation]
    check = package.validate(load(tmp_path / "c" / "a"), held, start=1.0)
    assert found.states == ("q", "q_dot")
    for name in found.states:
        expected = check.mean_nrmse("multi-fidelity", name)
        assert found.candidates[0].outcome.nrmse[name] == pytest.approx(expected, rel=1e-6)


def test_one_that_diverges_comes_after_all_that_do_not(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("dfsm.simulation.outcome.ESCAPE", 1.5)
    candidates = {"q": variant(states=(StateSpec(name="q"),)), "true": LINEAR}
    found = compare(candidates, runs, tmp_path / "c", validation=runs[:2], jobs=1)
    assert [c.status for c in found.candidates] == ["completed", "diverged"]
    last = found.candidates[-1]
    # The best by its errors, had it not left the range that this test narrows.
    assert (last.name, last.score, last.outcome.nrmse) == ("true", None, {"q": None})
    assert last.outcome.diverged > 0
    # Given validation runs are left out of the training runs.
    assert set(found.validation) == {"run0_0", "run0_1"}
    assert len(found.training) == 3


# -- going on where it was ended ------------------------------------------------------------------


def test_what_has_not_changed_is_not_fitted_again(runs, tmp_path, monkeypatch):
    fitted = []
    real = package.fit

    def counted(data, choices, refinement=None):
        fitted.append(choices)
        return real(data, choices, refinement)

    monkeypatch.setattr("dfsm.selection.trial.fit", counted)
    out, both = tmp_path / "c", {"a": LINEAR, "b": variant(linear=LTI())}
    first = compare(both, runs, out, jobs=1)
    before = files_of(out)
    again = compare(both, runs, out, jobs=1)
    assert len(fitted) == 2
    assert files_of(out) == before
    assert all(c.kept for c in again.candidates)
    assert [c.score for c in again.candidates] == [c.score for c in first.candidates]
    # Other settings, a damaged model, and other runs.
    compare(both | {"b": variant(linear=LTI(affine=False))}, runs, out, jobs=1)
    assert len(fitted) == 3
    (out / "a" / "model.safetensors").write_bytes(b"")
    (out / ".a.left").mkdir()
    compare(both | {"b": variant(linear=LTI(affine=False))}, runs, out, jobs=1)
    assert len(fitted) == 4
    assert sorted(p.name for p in out.iterdir()) == ["a", "a.json", "b", "b.json"]
    compare(both, runs[:4], out, jobs=1)
    assert len(fitted) == 6


def test_a_killed_comparison_goes_on(here):
    config = declared(**{f"c{i}": {"gate": 0.1 + i / 100} for i in range(4)})
    write_config(Path("c.yaml"), config)
    command = [sys.executable, "-c", "from dfsm.cli import main; main()"]
    command += ["compare", "c.yaml", "-o", "out", "--jobs", "2", "--json"]
    process = subprocess.Popen(command, start_new_session=True, stdout=subprocess.DEVNULL)
    wait_for(lambda: list(Path("out").glob("*.json")))
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    done = {p.stem for p in Path("out").glob("*.json")}
    for name in done:
        load(Path("out") / name)
    shown = subprocess.run(
        [sys.executable, "-c", "from dfsm.cli import main; main()", *command[3:-3], "--json"],
        capture_output=True,
        check=True,
    )
    found = json.loads(shown.stdout)
    assert {c["name"] for c in found["candidates"] if c["kept"]} == done
    assert {c["status"] for c in found["candidates"]} == {"completed"}


@pytest.mark.skipif(os.name == "nt", reason="no signals there")
def test_ctrl_c_ends_the_workers(here):
    config = declared(mlp={"corrective": {"kind": "mlp", "iterations": 100_000}}, a={"gate": 0.5})
    config["corrective"] = {"kind": "mlp", "iterations": 100_000, "hidden": [60, 60]}
    write_config(Path("c.yaml"), config)
    command = [sys.executable, "-c", "from dfsm.cli import main; main()"]
    command += ["compare", "c.yaml", "-o", "out", "--jobs", "2"]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE, text=True)
    wait_for(Path("out").exists)
    time.sleep(1.0)
    # As a terminal does: to the whole group.
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "interrupted: nothing was left half-written\n"
    wait_for(lambda: not group_lives(process.pid))


# -- the command line -----------------------------------------------------------------------------


def test_the_table_and_its_json(here, dfsm):
    unknown = {"signals": {"outputs": ["x[red]"]}}
    config = declared(q={"signals": {"states": [{"name": "q"}]}}, no=unknown)
    write_config(Path("c.yaml"), config)
    shown = dfsm("compare", "c.yaml", "-o", "out", "--jobs", "1")
    assert (shown.code, shown.err) == (0, "")
    lines = shown.out.splitlines()
    assert lines[0].split()[:4] == ["candidate", "score", "q", "rollouts"]
    assert [line.split()[0] for line in lines[1:4]] == ["base", "q", "no"]
    assert 'signals.states = [{"name": "q"}]' in lines[2]
    assert re.search(r"candidate no could not be fitted: .*no channel 'x\[red\]'", shown.out)
    assert re.search(r"^trained on: \S+, \S+$", shown.out, re.MULTILINE)
    assert re.search(r"^chosen on: \S+ \(", shown.out, re.MULTILINE)
    assert lines[-1].startswith(f"best: base, its model is {Path('out') / 'base'}")
    assert dfsm("summary", "out/base").code == 0
    again = dfsm("compare", "c.yaml", "-o", "out", "--json")
    assert (again.code, again.err) == (0, "")
    found = json.loads(again.out)
    assert found["best"] == "base"
    assert [c["kept"] for c in found["candidates"]] == [True, True, False]
    assert [c["status"] for c in found["candidates"]] == ["completed", "completed", "failed"]
    result = json.loads(Path("out/base.json").read_text())
    assert [r["name"] for r in result["validation"]] == found["validation"]
    quiet = dfsm("compare", "c.yaml", "-o", "out", "--quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_where_all_fail_the_exit_code_is_2(here, dfsm):
    config = declared(a={"gate": 0.5})
    config["signals"]["outputs"] = ["nope"]
    write_config(Path("c.yaml"), config)
    said = dfsm("compare", "c.yaml", "-o", "out", "--jobs", "1").sentence
    assert said.count("no channel 'nope'") == 2


def test_fit_takes_no_notice(here, dfsm):
    write_config(Path("c.yaml"), declared(a={"gate": 0.5}))
    assert dfsm("fit", "c.yaml", "-o", "m", "--quiet").code == 0


def test_nothing_else_is_written_over(here, dfsm):
    write_config(Path("c.yaml"), declared(a={"gate": 0.5}))
    Path("file").write_text("mine")
    assert (
        "file is a file, a folder was expected" in dfsm("compare", "c.yaml", "-o", "file").sentence
    )
    Path("out").mkdir()
    Path("out/a.json").write_text("{}")
    assert "a.json is no result of a comparison" in dfsm("compare", "c.yaml", "-o", "out").sentence
    Path("out/base").mkdir()
    Path("out/base/mine").write_text("mine")
    assert "not a folder that dfsm wrote" in dfsm("compare", "c.yaml", "-o", "out").sentence
    assert "no folder none" in dfsm("compare", "c.yaml", "-o", "none/out").sentence


# -- configuration --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"corrective": {"kind": "gb"}},
            "'compare.candidates.x.corrective.kind' is 'gb', expected one of 'rbf', "
            "'rbf_incremental', 'gp', 'mlp', 'none'; known are: rbf, rbf_incremental, gp, mlp, "
            "none",
        ),
        (
            {"corrective": {"kind": "gp", "hiden": 3}},
            "unknown key 'compare.candidates.x.corrective.hiden'; known are: kind, samples, "
            "sampling, targets",
        ),
        ({"sed": 3}, "unknown key 'compare.candidates.x.sed'; did you mean 'seed'?"),
        ({"linear": {"kind": "LPV"}}, "key 'compare.candidates.x.linear.schedule' is missing"),
        (
            {"refine": {"latents": 3}},
            "compare.candidates.x: refine.latents is 3, expected an even number: they come in "
            "pairs",
        ),
        (
            {"data": {"start": 3}},
            "'compare.candidates.x.data' cannot be changed, candidates are compared on the same "
            "runs: change 'data' for all of them",
        ),
        (
            {"signals": {"states": [{"name": "z"}]}},
            "the candidates have no state in common, so nothing ranks them: keep one",
        ),
        (3, "'compare.candidates.x': keys and values were expected, as {key: value}, not 3"),
    ],
)
def test_mistakes_carry_the_path_of_their_key(tmp_path, changes, expected):
    # The runs that the configuration names do not exist here.
    assert complaint(tmp_path, declared(x=changes)) == expected


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({}, "'compare.candidates' is missing: name what to try there"),
        ({"candidates": {"base": {}}}, "'compare.candidates.base' is the configuration itself"),
        ({"candidates": {"a/b": {}}}, "candidate 'a/b' cannot be the name of a folder"),
        ({"candidates": {"Base": {}}}, "two candidates differ only in upper and lower case"),
        ({"candidates": {"a": {}}, "hold_out": 2}, "compare.hold_out is 2.0, expected a share"),
        ({"candidates": {"a": {}}, "hold_ot": 2}, "unknown key 'compare.hold_ot'; did you mean"),
        (
            {"candidates": {"a": {}}, "hold_out": 0.2, "validation": ["x"]},
            "compare.hold_out is 0.2, expected no value beside compare.validation",
        ),
    ],
)
def test_sections_without_sense(tmp_path, section, expected):
    assert complaint(tmp_path, changed("compare", value=section)).startswith(expected)


def test_what_a_candidate_changes(tmp_path):
    config = declared(
        gp={"corrective": {"kind": "gp"}},
        deep={"linear": {"margin": 0.1}, "signals": {"outputs": []}},
        lti={"linear": {"kind": "LTI"}},
        refined={"refine": {"latents": 2}},
    )
    config["linear"] = {"kind": "LPV", "schedule": "w", "points": 3}
    config["corrective"] = {"kind": "mlp", "hidden": [3]}
    _, found = parse_candidates(write_config(tmp_path / "c.yaml", config))
    assert list(found) == ["base", "gp", "deep", "lti", "refined"]
    assert found["gp"].settings == replace(found["base"].settings, corrective=GP())
    assert found["lti"].settings.linear == LTI()
    assert found["deep"].settings.linear == LPV(schedule="w", points=3, margin=0.1)
    assert found["deep"].settings.outputs == ()
    assert found["deep"].changes == "linear.margin = 0.1; signals.outputs = []"
    assert found["refined"].refine is not None
    assert found["refined"].refine.latents == 2


def test_the_example_of_the_template_holds(here):
    write_template(["train/a.csv"], Path("config.yaml"))
    text = Path("config.yaml").read_text(encoding="utf-8")
    head, example = text.split("# compare:\n")
    Path("config.yaml").write_text(head + "compare:\n" + re.sub("^# ", "", example, flags=re.M))
    raw = YAML(typ="safe").load(Path("config.yaml").read_text(encoding="utf-8"))
    raw["signals"]["states"] = [{"name": "q"}]
    raw["signals"]["controls"] = ["u"]
    write_config(Path("config.yaml"), raw)
    assert parse_config(Path("config.yaml")).compare.hold_out == 0.2
    _, found = parse_candidates("config.yaml")
    assert list(found) == ["base", "gp", "linear", "refined"]


def test_of_one_record_the_last_part_in_time_judges(tmp_path: Path) -> None:
    """The right structure wins on what comes after the record it was trained with."""
    run = SCHEDULED.many(1, [(0, 1), (4, 4)], np.arange(0, 40.01, 0.05))[0]
    right = replace(LINEAR, settings=replace(LINEAR.settings, linear=LTI(), start=2.0, stop=32.0))
    lazy = StateSpec(name="q", order=1)
    wrong = replace(right, settings=replace(right.settings, states=(lazy,)))
    ranking = compare({"wrong": wrong, "right": right}, [run], tmp_path / "c", jobs=1)
    assert [c.name for c in ranking.candidates] == ["right", "wrong"]
    assert ranking.training == (f"{run.name} until 26 s",)
    assert ranking.validation == (f"{run.name} after 26 s",)
    # The model knows nothing of what judged it: it is that of the first part alone.
    alone = fit([run.window(None, 26.0)], right.settings).model
    assert ranking.best is not None
    assert ranking.best.folder is not None
    found, x = load(ranking.best.folder), np.array([0.3, -0.2])
    rates = (m.derivative(x, np.array([0.5]), np.array([1.0])) for m in (found, alone))
    np.testing.assert_allclose(*rates, rtol=1e-9)
    short = run.window(2.0, 2.15)
    with pytest.raises(DfsmError, match="has 4 samples, too few to train with the first"):
        compare({"wrong": wrong, "right": right}, [short], tmp_path / "d", jobs=1)
