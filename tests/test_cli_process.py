"""The command line as a process: streams, exit codes, interruptions."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from conftest import changed, files_of, renamed, write_config
from dfsm import fit as fit_function
from dfsm.config.fit import load_config
from dfsm.data.readers import read
from dfsm.data.readers.tables import write_table
from dfsm.errors import DfsmError, DfsmWarning

SCRIPT = Path(sys.executable).with_name("dfsm")


def test_help_and_no_arguments(dfsm):
    shown = dfsm("--help")
    assert (shown.code, shown.err) == (0, "")
    for command in ("info", "init", "fit", "summary", "validate", "simulate"):
        assert re.search(rf"^  {command} ", shown.out, re.MULTILINE)
    bare = dfsm()
    assert (bare.code, bare.out) == (2, "")
    assert bare.err == shown.out


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("nope",), "no such command 'nope'; see dfsm --help"),
        (("fit",), "missing argument 'config'; see dfsm fit --help"),
        (("fit", "c.yaml"), r"missing option '--output' / '-o'; see dfsm fit --help"),
        (("info", "--nope", "x"), "no such option: --nope; see dfsm info --help"),
    ],
)
def test_usage_errors_are_one_sentence(dfsm, arguments, match):
    assert re.fullmatch(match, dfsm(*arguments).sentence)


def test_a_bug_exits_with_3_and_says_so(here, dfsm, monkeypatch):
    def broken(path):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("dfsm.models.model_folder.load", broken)
    shown = dfsm("summary", "m")
    assert shown.code == 3
    assert shown.err.splitlines()[0] == "bug in dfsm: ZeroDivisionError: division by zero"
    assert "DFSM_DEBUG=1" in shown.err


def test_a_warning_is_shown_once(here, dfsm, monkeypatch):
    def twice(path):
        for text in ("one", "two", "one"):
            warnings.warn(text, DfsmWarning, stacklevel=1)
        raise DfsmError("enough")

    monkeypatch.setattr("dfsm.models.model_folder.load", twice)
    for _ in range(2):  # each command by itself
        assert dfsm("summary", "m").err.splitlines() == [
            "warning: one",
            "warning: two",
            "error: enough",
        ]


@pytest.mark.parametrize("command", ["fit", "save"])
def test_ctrl_c_leaves_nothing_half_written(here, dfsm, monkeypatch, command):
    write_config(Path("c.yaml"), changed("corrective", value={"kind": "none"}))

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    if command == "fit":
        monkeypatch.setattr("dfsm.fitting.samples.differentiate", interrupt)
    else:
        monkeypatch.setattr("dfsm.core.bundle.json_bytes", interrupt)
    before = files_of(here)
    shown = dfsm("fit", "c.yaml", "-o", "m")
    assert (shown.code, shown.out) == (130, "")
    assert shown.err == "interrupted: nothing was left half-written\n"
    assert files_of(here) == before


def test_ctrl_c_in_a_real_process(here):
    # A pipe that nobody writes to: the command waits in open() until the signal comes.
    os.mkfifo("slow.csv")
    process = subprocess.Popen(
        [SCRIPT, "info", "slow.csv"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    writer = os.open("slow.csv", os.O_WRONLY)  # returns as soon as the command has opened it
    time.sleep(2.0)  # and is waiting for data, even on a busy machine
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    os.close(writer)
    assert (process.returncode, out) == (130, "")
    assert err.strip() == "interrupted: nothing was left half-written"


def test_a_reader_that_has_gone_is_no_error(here):
    for option in ((), ("--json",)):
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(
            [SCRIPT, "info", "train/a.csv", *option],
            stdout=writer,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_standard_output_on_a_full_disk(here):
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [SCRIPT, "info", "train/a.csv"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    assert done.returncode == 2
    assert re.fullmatch(r"error: standard output .*No space left on device.*\n", done.stderr)


def test_the_package_runs_as_a_module(here):
    done = subprocess.run(
        [sys.executable, "-m", "dfsm", "info", "train/a.csv"], capture_output=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_terminal_without_unicode_gets_escapes(here):
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        [SCRIPT, "info", "train/a.csv"], capture_output=True, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\u2013" in done.stdout


def test_warnings_reach_python_callers_too(here):
    run = read("train/a.csv")
    write_table(renamed(run, {"w": "RtVAvgxh"}), "r.parquet")
    config = changed("data", "train", value=["r.parquet"]) | {"corrective": {"kind": "none"}}
    config["signals"]["disturbances"] = ["RtVAvgxh"]
    settings, runs = load_config(write_config(Path("c.yaml"), config))
    with pytest.warns(DfsmWarning, match="relative to the moving rotor"):
        fit_function(runs, settings.fit_settings())
