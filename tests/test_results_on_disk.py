"""Where results go: what is refused before the work, and what a failure leaves behind."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from conftest import CONFIG, files_of, write_config
from dfsm.data.readers import read


@pytest.fixture
def idle(monkeypatch):
    """Make every long step fail loudly, to show that a bad target is found before it."""

    def work(*_, **__):
        raise AssertionError("worked before looking at the target")

    for place in ("fitting.fit", "simulation.simulate", "validation.validate"):
        monkeypatch.setattr(f"dfsm.{place}.{place.split('.')[1]}", work)


def writers(model, path):
    """Every command that writes, told to write to `path`."""
    return [
        ("init", "train/*", "--force", "-o", path),
        ("fit", "config.yaml", "-o", path),
        ("validate", model, "test/d.outb", "-o", path),
        ("validate", model, "test/d.outb", "--json", path),
        ("simulate", model, "test/d.outb", "-o", path),
    ]


def test_a_missing_folder_fails_before_the_work(here, dfsm, fitted, idle):
    write_config(Path("config.yaml"), CONFIG)
    for command in writers(fitted, "no/where.csv"):
        said = dfsm(*command).sentence
        assert said == "no/where.csv could not be written: there is no folder no, make it first"


def test_a_read_only_folder_fails_before_the_work(here, dfsm, fitted, idle, monkeypatch):
    write_config(Path("config.yaml"), CONFIG)
    monkeypatch.setattr("os.access", lambda _, mode, **__: mode != os.W_OK)  # root may write
    for command in writers(fitted, "here.csv"):
        assert dfsm(*command).sentence.startswith("here.csv could not be written: the folder")


def test_a_target_of_another_kind_fails_before_the_work(here, dfsm, fitted, idle):
    write_config(Path("config.yaml"), CONFIG)
    Path("dir.csv").mkdir()
    Path("dir.csv/mine").write_text("precious")
    before = files_of(here)
    for command in writers(fitted, "dir.csv"):
        expected = "is not a folder that dfsm wrote" if command[0] == "fit" else "is a folder"
        assert expected in dfsm(*command).sentence
    said = dfsm("fit", "config.yaml", "-o", "config.yaml").sentence
    assert "is not a folder that dfsm wrote" in said
    said = dfsm("simulate", fitted, "test/d.outb", "-o", "out.txt").sentence
    assert "written to .parquet or .csv" in said
    assert files_of(here) == before


def test_the_working_folder_cannot_be_the_model(here, dfsm, idle, monkeypatch):
    path = write_config(here / "config.yaml", CONFIG)
    (here / "new").mkdir()
    monkeypatch.chdir(here / "new")
    said = dfsm("fit", path, "-o", ".").sentence
    assert said.startswith(". is the working folder or a mount point")


def test_a_device_is_never_replaced(here, dfsm, fitted, idle):
    Path("pipe.csv").symlink_to("/dev/null")
    for command in writers(fitted, "pipe.csv"):
        if command[0] != "fit":
            assert "is a device or a pipe" in dfsm(*command).sentence
    assert not Path("/dev/null").is_file()


def test_a_result_never_replaces_what_it_was_made_of(here, dfsm, fitted):
    for name in ("train/a.csv", "test/d.outb"):
        shutil.copy(name, Path(name).name)
    Path("w.json").write_text("{}")
    before = files_of(here)
    validate = ("validate", fitted, "d.outb", "--wall-times", "w.json")
    for command in (
        ("simulate", fitted, "a.csv", "-o", "./a.csv"),
        (*validate, "--json", "w.json"),
    ):
        assert "is one of the files to read" in dfsm(*command).sentence
    assert "a page ends in .html" in dfsm(*validate, "-o", "d.outb").sentence
    assert files_of(here) == before


def test_a_link_stays_a_link(here, dfsm, fitted):
    Path("disk").mkdir()
    Path("disk/out.csv").write_text("old")
    Path("out.csv").symlink_to("disk/out.csv")
    assert dfsm("simulate", fitted, "test/d.outb", "-o", "out.csv").code == 0
    assert Path("out.csv").is_symlink()
    assert read("disk/out.csv").names == ("q", "q_dot", "y", "z")


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), None])
@pytest.mark.parametrize("target", ["config.yaml", "m", "r.html", "r.json", "o.csv", "o.parquet"])
def test_a_full_disk_or_ctrl_c_while_writing(
    here, dfsm, fitted, monkeypatch, target, existing, failure
):
    """Injected where the finished file would take its place: the worst moment."""
    commands = {
        "config.yaml": ("init", "train/*", "--force"),
        "m": ("fit", "c.yaml", "-o", "m"),
        "r.html": ("validate", fitted, "test/d.outb", "-o", "r.html"),
        "r.json": ("validate", fitted, "test/d.outb", "--json", "r.json"),
    }
    simulate = ("simulate", fitted, "test/d.outb", "-o", target)
    write_config(Path("c.yaml"), CONFIG | {"corrective": {"kind": "none"}})
    if existing and target == "m":
        shutil.copytree(fitted, "m")
    elif existing:
        Path(target).write_text("old")
    before = files_of(here)

    def fail(self, *_, **__):
        raise failure or KeyboardInterrupt

    monkeypatch.setattr(Path, "chmod", fail)
    shown = dfsm(*commands.get(target, simulate), "--quiet")
    monkeypatch.undo()
    monkeypatch.chdir(here)
    assert shown.out == ""
    if failure:
        said = shown.sentence
        assert f"{target} could not be written (No space left on device)" in said
    else:
        assert shown.code == 130
        assert shown.err == "interrupted: nothing was left half-written\n"
    assert files_of(here) == before
