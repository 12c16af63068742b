"""Compiled code kept between processes, and what a command does not import."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import install
from conftest import changed, write_config
from dfsm.core.compile_cache import Entries, cache_folder

# Compiles something through the package, says what JAX took from the cache, and warnings.
COMPILES = """
import jax.monitoring
told = []
jax.monitoring.register_event_listener(lambda name, **_: told.append(name.rsplit("/")[-1]))
import dfsm.core.jax_setup
import jax
print(float(jax.jit(lambda x: x * 3)(2.0)), told.count("cache_hits"), told.count("cache_misses"))
"""


def python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {k: v for k, v in os.environ.items() if "CACHE" not in k}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        env=kept | environment,
        capture_output=True,
        text=True,
        check=True,
    )


def entries_of(folder: Path) -> list[Path]:
    return sorted(folder.glob("jax-*/*.compiled"))


def test_a_second_process_takes_what_the_first_compiled_unless_it_is_damaged(tmp_path):
    cache = {"DFSM_CACHE": str(tmp_path)}
    first = python(COMPILES, **cache)
    kept = entries_of(tmp_path)
    assert kept
    assert first.stdout.split() == ["6.0", "0", str(len(kept))]
    # Only the user may write what is executed.
    assert kept[0].parent.stat().st_mode & 0o022 == 0

    second = python(COMPILES, **cache)
    assert second.stdout.split() == ["6.0", str(len(kept)), "0"]
    assert entries_of(tmp_path) == kept

    # One cut off, one with a flipped bit: compiled again, without a word, and replaced.
    whole = {path: path.read_bytes() for path in kept}
    for path, content in whole.items():
        path.write_bytes(content[: len(content) // 2])
    flipped = bytearray(whole[kept[0]])
    flipped[-5] ^= 1
    kept[0].write_bytes(flipped)
    third = python(COMPILES, **cache)
    assert third.stdout.split() == ["6.0", "0", str(len(kept))]
    assert (third.stderr, entries_of(tmp_path)) == ("", kept)
    now = [path.read_bytes() for path in kept]
    assert all(hashlib.sha256(content[32:]).digest() == content[:32] for content in now)


def test_the_users_own_settings_go_first(tmp_path):
    code = COMPILES + "print(jax.config.jax_compilation_cache_dir)"
    off = python(code, DFSM_CACHE="off", HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path))
    assert off.stdout.split() == ["6.0", "0", "0", "None"]
    assert list(tmp_path.iterdir()) == []
    own = python(code, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"), DFSM_CACHE=str(tmp_path))
    assert own.stdout.split()[-1] == str(tmp_path / "own")
    assert entries_of(tmp_path) == []


def test_where_it_is(tmp_path, monkeypatch):
    monkeypatch.setenv("DFSM_CACHE", str(tmp_path))
    at = cache_folder()
    assert at is not None
    assert at.parent == tmp_path
    for word in ("off", "OFF", "0", "none"):
        monkeypatch.setenv("DFSM_CACHE", word)
        assert cache_folder() is None
    monkeypatch.delenv("DFSM_CACHE")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    at = cache_folder()
    assert at is not None
    assert at.parent == tmp_path / "x" / "dfsm"


def test_entries_make_room_for_one_another(tmp_path):
    entries = Entries(tmp_path / "c", limit=1000, kept=500)
    for k in range(4):
        entries.put(f"k{k}", bytes([k]) * 100)
        os.utime(tmp_path / "c" / f"k{k}.compiled", (k, k))
    assert entries.get("k0") == bytes(100)  # and so it is used later than the others
    entries.put("large", b"x" * 500)
    assert [k for k in range(4) if entries.get(f"k{k}") is not None] == []
    assert entries.get("large") == b"x" * 500
    again = Entries(tmp_path / "c", limit=1000, kept=900)
    for k in (5, 6, 7):
        again.put(f"k{k}", bytes(100))
    os.utime(tmp_path / "c" / "large.compiled", (1, 1))
    again.put("k8", bytes(100))
    assert again.get("large") is None
    assert all(again.get(f"k{k}") == bytes(100) for k in (5, 6, 7, 8))


def test_what_a_killed_process_left_goes_and_a_folder_that_cannot_be_used_is_none(tmp_path):
    folder = tmp_path / "c"
    entries = Entries(folder)
    for name, age in (("old.writing", 7200), ("new.writing", 10)):
        (folder / name).write_bytes(b"half")
        os.utime(folder / name, (time.time() - age, time.time() - age))
    entries.put("k", b"value")
    assert {p.name for p in folder.iterdir()} == {"new.writing", "k.compiled"}
    assert entries.get("nothing") is None
    (tmp_path / "file").write_text("")
    assert not Entries(tmp_path / "file").usable
    if hasattr(os, "getuid"):
        folder.chmod(0o777)
        assert not Entries(folder).usable
    # Nothing that goes wrong is an error.
    Entries(tmp_path / "file").put("k", b"value")


HEAVY = (
    *("pandas", "plotly", "sklearn", "diffrax", "optimistix", "matplotlib", "casadi", "fatpack"),
    *("scipy.signal", "scipy.stats", "pyarrow.compute", "dfsm.fitting.fit", "dfsm.control"),
)


@pytest.mark.parametrize(
    ("command", "allowed"),
    [
        (("simulate", "m", "test/d.outb", "-o", "o.parquet"), ()),
        (("info", "train/b.parquet"), ()),
        (("--help",), ()),
    ],
)
def test_a_command_imports_what_it_needs(folder, fitted, tmp_path, command, allowed):
    code = (
        "import sys; from dfsm import cli\n"
        f"sys.argv = ['dfsm', *{command!r}]\n"
        "try:\n    cli.main()\nexcept SystemExit as stop:\n    assert not stop.code, stop.code\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)\n"
        "print('jax' in sys.modules, file=sys.stderr)"
    )
    for name in ("m", "test", "train"):
        (tmp_path / name).symlink_to(folder / name)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    *_, heavy, jax = done.stderr.splitlines()
    assert heavy == str(list(allowed))
    assert jax == str(command[0] == "simulate")


def test_timings_say_where_a_fit_spends_its_time(here, dfsm):
    write_config(Path("c.yaml"), changed("corrective", value={"kind": "none"}))
    shown = dfsm("fit", "c.yaml", "-o", "m", "--timings", "--quiet")
    assert (shown.code, shown.out) == (0, "")
    *steps, last = shown.err.splitlines()
    pairs = [re.findall(r"(\S.*?) +([\d.]+) s", line)[0] for line in steps]
    told = {name: float(seconds) for name, seconds in pairs}
    assert {"derivatives", "linear fit", "outputs", "reading and saving"} <= set(told)
    ((total, compiling, programs),) = re.findall(
        r"^in all +([\d.]+) s, of which compiling ([\d.]+) s \((\d+) programs\)$", last
    )
    assert float(total) == pytest.approx(sum(told.values()), abs=0.1)
    assert (float(compiling) > 0) == (int(programs) > 0)


def test_what_an_installation_takes_is_told_by_package():
    core, more = install.needed("dfsm"), install.needed("dfsm", ("openfast",))
    assert {"jax", "jaxlib", "numpy", "casadi"} <= core < more
    assert more - core >= {"openfast-io"}
    assert install.megabytes("numpy") > 10 > install.megabytes("typer") > 0
    assert install.megabytes("no-such-package") == 0
