"""Killed at any file event, a target is whole; two processes never write to one place."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conftest import files_of
from dfsm.core.exchange import swap
from dfsm.core.fallback import write_or_keep
from dfsm.core.files import check_folder, write_file, write_folder
from dfsm.core.lock import locked
from dfsm.errors import DfsmError

pytestmark = pytest.mark.skipif(os.name == "nt", reason="other system calls there")

# In a process without JAX's threads, which can be copied.
KILLED = """
import json, sys
import dfsm.core.exchange
from pathlib import Path
from benchmarks.kill import forked, killed_everywhere
from dfsm.core.bundle import Bundle

def write():
    Bundle("a.safetensors", 1, "again").write(
        "m", {}, {"new": True}, lambda p: True, {"page.html": lambda f: f.write_text("page")}
    )

steps = sys.argv[2] == "steps"
if steps:
    dfsm.core.exchange.swap = lambda *_: False
source, found = Path(sys.argv[1]), []
for full in (False, True):
    found.append(killed_everywhere(forked(write), source, "m", full=full, in_steps=steps))
print(json.dumps(found))
"""


def ours(path: Path) -> bool:
    return {p.name for p in path.iterdir() if not p.name.startswith(".")} == {"a"}


def put(path: Path, text: str) -> None:
    with write_folder(path, is_ours=ours) as folder:
        (folder / "a").write_text(text)


def can_swap(folder: Path) -> bool:
    for name in ("one", "two"):
        (folder / name).mkdir()
    return swap(folder / "one", folder / "two")


@pytest.mark.parametrize("way", ["exchange", "steps"])
def test_a_folder_is_whole_whenever_its_writer_is_killed(tmp_path, way):
    if way == "exchange" and not can_swap(tmp_path):
        pytest.skip("no exchange of names on this system")
    source = tmp_path / "source"
    (source / "m").mkdir(parents=True)
    (source / "m" / "old").write_text("old")
    (source / "m" / ".DS_Store").write_text("a file manager's")
    root = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", KILLED, source, way],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(root), str(root / "src")])},
        capture_output=True,
        text=True,
        check=True,
    )
    killed, full = json.loads(done.stdout)
    assert killed[1] == full[1] == []
    assert killed[0] > 8


def test_dot_files_bother_nobody_and_stay(tmp_path):
    path = tmp_path / "m"
    path.mkdir()
    (path / ".DS_Store").write_text("seen")
    put(path, "one")
    put(path, "two")
    assert files_of(tmp_path) == {"m/a": b"two", "m/.DS_Store": b"seen"}
    # A folder may be somebody's whatever its name.
    (tmp_path / "home" / ".config").mkdir(parents=True)
    with pytest.raises(DfsmError, match="is not a folder that dfsm wrote"):
        check_folder(tmp_path / "home", is_ours=ours)


def test_what_a_killed_writer_left_is_put_back_on_the_next_start(tmp_path):
    path = tmp_path / "m"
    put(path, "old")
    aside = tmp_path / ".m.dfsm-old-1"
    aside.mkdir()
    path.rename(aside / "replaced")
    (tmp_path / ".m.dfsm-new-2").mkdir()
    (tmp_path / ".m.other").write_text("mine")
    check_folder(path, is_ours=ours)
    assert files_of(tmp_path) == {"m/a": b"old", ".m.other": b"mine"}
    assert sorted(p.name for p in tmp_path.iterdir()) == [".m.other", "m"]


def test_a_link_to_a_folder_stays_a_link(tmp_path):
    put(tmp_path / "m", "one")
    (tmp_path / "link").symlink_to("m")
    put(tmp_path / "link", "two")
    assert (tmp_path / "link").is_symlink()
    assert files_of(tmp_path / "m") == {"a": b"two"}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "m"]


HOLD = """
import sys, time
from dfsm.core.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


def test_two_processes_never_write_to_one_place(tmp_path):
    path = tmp_path / "m"
    put(path, "old")
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, path],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1] / "src")},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    said = rf"m is being written by another process \({other.pid}\): wait until it has ended"
    with pytest.raises(DfsmError, match=said):
        put(path, "new")
    assert files_of(path) == {"a": b"old"}
    # A process that was killed holds nothing.
    other.kill()
    other.communicate()
    with locked(path):
        put(path, "new")
    assert files_of(tmp_path) == {"m/a": b"new"}


def test_a_result_without_room_is_offered_elsewhere(tmp_path, monkeypatch):
    scratch, full = tmp_path / "scratch", tmp_path / "full"
    for folder in (scratch, full):
        folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(scratch))
    write_text = Path.write_text

    def no_room(self, text):
        if full in self.parents:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write_text(self, text)

    monkeypatch.setattr(Path, "write_text", no_room)
    with pytest.raises(DfsmError) as caught:
        write_or_keep(lambda path: put(path, "hours of work"), full / "m")
    (kept,) = scratch.iterdir()
    assert str(caught.value) == (
        f"{full / 'm'} could not be written (No space left on device), so the result is in "
        f"{kept / 'm'}: make room and move it"
    )
    assert files_of(kept) == {"m/a": b"hours of work"}
    assert not list(full.iterdir())
    # Nor is there room elsewhere.
    full = tmp_path
    with pytest.raises(DfsmError, match="nothing was left behind"):
        write_or_keep(lambda path: put(path, "hours of work"), full / "full" / "m")
    assert [*scratch.iterdir()] == [kept]
    # Other mistakes are not mended by another place.
    with pytest.raises(DfsmError, match="there is no folder"):
        write_or_keep(lambda path: put(path, ""), full / "no" / "m")


def test_an_ended_command_cleans_up_like_an_interrupted_one(here):
    os.mkfifo("slow.csv")
    process = subprocess.Popen(
        [Path(sys.executable).with_name("dfsm"), "info", "slow.csv"],
        stderr=subprocess.PIPE,
        text=True,
    )
    writer = os.open("slow.csv", os.O_WRONLY)
    time.sleep(1.0)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    os.close(writer)
    assert (process.returncode, err) == (130, "interrupted: nothing was left half-written\n")


def test_a_file_that_a_killed_writer_left_is_removed_by_the_next(tmp_path):
    (tmp_path / ".a.txt.dfsm-new-1").write_text("half")
    with write_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("whole")
    assert files_of(tmp_path) == {"a.txt": b"whole"}
