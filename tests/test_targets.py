"""What commands write over: their own results, neither training runs nor files of other kinds."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from conftest import DUFFING, Dfsm, changed, files_of, write_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table

LAW = """
import dfsm
mine = dfsm.PID(
    kp=-0.5, ki=-0.1, setpoint=0.0, measurements=["q"], measurement_units=["m"],
    commands=["u"], command_units=["N"], interval=0.05,
)
"""


@pytest.fixture
def beside(here: Path) -> Path:
    """A working folder that holds the runs themselves, not links to them."""
    for name in ("train", "test"):
        shutil.copytree(here / name, here / f"{name}ing")
    Path("notes.yaml").write_text("mine: true\n")
    return here


def test_pages_and_figures_are_no_other_files(beside, dfsm: Dfsm, fitted):
    runs = ("training/a.csv", "training/b.parquet", "training/c.outb")
    loop = ("closed-loop", fitted, "test/d.outb", "-o", "out", "--controller", "law.py:mine")
    before = files_of(beside)
    for target in ("notes.yaml", "testing/d.outb", "new.pdf", "page"):
        for command in (
            ("report", fitted, "-o"),
            ("validate", fitted, "test/d.outb", "-o"),
            (*loop, "--report"),
        ):
            said = dfsm(*command, target).sentence
            assert said == f"{target}: a page ends in .html or .htm: choose a name that does"
        for command, what in (
            (("validate", fitted, "test/d.outb", "--json"), "a file of figures"),
            (("calibrate", fitted, *runs, "-o"), "a file of intervals"),
        ):
            said = dfsm(*command, target).sentence
            assert said == f"{target}: {what} ends in .json: choose a name that does"
    assert files_of(beside) == before


def test_results_are_replaced_and_runs_that_taught_the_model_are_not(beside, dfsm: Dfsm, fitted):
    Path("law.py").write_text(LAW)
    shutil.copy("training/a.csv", "other.csv")
    named = Path("training") / f"{read('train/b.parquet').name}.parquet"  # as the loop's run
    shutil.copy("train/b.parquet", named)
    before = files_of(beside)
    for target in ("training/a.csv", "training/b.parquet", "other.csv"):
        said = dfsm("simulate", fitted, "test/d.outb", "-o", target).sentence
        assert said.startswith(f"{target} is a run that taught the model {fitted}")
    said = dfsm("export", "casadi", fitted, "-o", "other.csv").sentence
    assert said.startswith("other.csv is a run that taught the model")
    loop = ("--controller", "law.py:mine", "--start-up", "2")
    said = dfsm("closed-loop", fitted, "train/b.parquet", "-o", "training", *loop).sentence
    assert said.startswith(f"{named} is a run that taught the model")
    assert files_of(beside) == before
    for _ in range(2):  # the second time over the first
        assert dfsm("simulate", fitted, "train/b.parquet", "-o", "b.parquet").code == 0
        assert dfsm("simulate", fitted, "train/a.csv", "-o", "a.csv").code == 0
        assert dfsm("closed-loop", fitted, "train/b.parquet", "-o", "out", *loop).code == 0
        assert dfsm("report", fitted, "-o", "Card.HTM").code == 0
        options = ("-o", "page.html", "--json", "figures.json")
        assert dfsm("validate", fitted, "test/d.outb", *options).code == 0


def test_files_of_the_model_are_not_replaced(beside, dfsm: Dfsm, fitted):
    shutil.copytree(fitted, "m")
    before = files_of(beside)
    said = dfsm("validate", "m", "test/d.outb", "--json", "m/manifest.json").sentence
    assert said.startswith("m/manifest.json is one of the files to read")
    Path("p.csv").write_text("run,mass\nd.outb,2\n")
    said = dfsm("simulate", "m", "test/d.outb", "--parameters", "p.csv", "-o", "p.csv").sentence
    assert said.startswith("p.csv is one of the files to read")
    Path("p.csv").unlink()
    assert files_of(beside) == before


def test_training_runs_without_times_are_known_too(beside, dfsm: Dfsm):
    time = np.arange(0, 15.01, 0.05)
    for k, run in enumerate(DUFFING.many(3, [(0.3, 1.0), (0.0, 1.0)], time, seed=8)):
        write_table(run, Path(f"timed{k}.csv"))
        head, *rows = Path(f"timed{k}.csv").read_text().splitlines()
        lines = [line.split(",", 1)[1] for line in (head, *rows)]
        Path(f"bare{k}.csv").write_text("\n".join(lines) + "\n")
    config = changed("data", value={"train": ["bare0.csv", "bare1.csv"], "step": 0.05})
    config["corrective"] = {"kind": "none"}
    write_config(Path("c.yaml"), config)
    assert dfsm("fit", "c.yaml", "-o", "m", "-q").code == 0
    for options in ((), ("--sample-step", "0.05")):
        said = dfsm("simulate", "m", "timed2.csv", "-o", "bare1.csv", *options).sentence
        assert said.startswith("bare1.csv is a run that taught the model m")
    # A result that bears the name of a training run.
    Path("results").mkdir()
    for _ in range(2):
        assert dfsm("simulate", "m", "timed2.csv", "-o", "results/bare1.csv").code == 0
    assert read("results/bare1.csv").names == ("q", "q_dot", "y", "z")
