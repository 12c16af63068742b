"""Nothing is ever half-written: failures, Ctrl-C and full disks leave what was there before."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from dfsm.core.files import check_together, write_file, write_folder, write_together
from dfsm.errors import DfsmError

NO_SPACE = OSError(errno.ENOSPC, "No space left on device")


def ours(path: Path) -> bool:
    return {p.name for p in path.iterdir()} <= {"manifest.json", "arrays"}


def names(path: Path) -> set[str]:
    return {p.name for p in path.iterdir()}


def half_a_file(path: Path, failure: BaseException) -> None:
    with write_file(path) as temporary:
        temporary.write_text("half of the n")
        raise failure


def half_a_folder(path: Path, failure: BaseException) -> None:
    with write_folder(path, is_ours=ours) as temporary:
        (temporary / "manifest.json").write_text("half")
        raise failure


def new_folder(path: Path) -> None:
    with write_folder(path, is_ours=ours) as temporary:
        fill(temporary, "new")


# -- files --------------------------------------------------------------------------------------


def test_a_file_is_written_and_replaced(tmp_path):
    path = tmp_path / "a.txt"
    for content in ("one", "two"):
        with write_file(path) as temporary:
            temporary.write_text(content)
            assert not path.exists() or path.read_text() != content
        assert path.read_text() == content
        assert names(tmp_path) == {"a.txt"}
    ordinary = tmp_path / "b.txt"
    ordinary.write_text("")
    assert path.stat().st_mode == ordinary.stat().st_mode


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("failure", [RuntimeError("x"), KeyboardInterrupt(), NO_SPACE])
def test_a_failure_leaves_the_old_file(tmp_path, existing, failure):
    path = tmp_path / "a.txt"
    if existing:
        path.write_text("old")
    expected = DfsmError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected) as caught:
        half_a_file(path, failure)
    if expected is DfsmError:
        assert "a.txt could not be written (No space left on device)" in str(caught.value)
    assert names(tmp_path) == ({"a.txt"} if existing else set())
    if existing:
        assert path.read_text() == "old"


def test_a_file_cannot_replace_a_folder_or_go_nowhere(tmp_path):
    for path, match in (
        (tmp_path, "is a folder, a file name was expected"),
        (tmp_path / "nowhere" / "a.txt", "could not be written"),
    ):
        with pytest.raises(DfsmError, match=match), write_file(path):
            pass


def test_a_failing_rename_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def refuse(self, target):
        raise NO_SPACE

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(DfsmError, match="No space left"), write_file(path) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "old"
    assert names(tmp_path) == {"a.txt"}


# -- folders ------------------------------------------------------------------------------------


def fill(folder: Path, content: str) -> None:
    (folder / "manifest.json").write_text(content)
    (folder / "arrays").write_text(content)


def test_a_folder_is_written_and_replaced(tmp_path):
    path = tmp_path / "model"
    for content in ("one", "two"):
        with write_folder(path, is_ours=ours) as temporary:
            fill(temporary, content)
        assert (path / "manifest.json").read_text() == content
        assert names(tmp_path) == {"model"}
    ordinary = tmp_path / "ordinary"
    ordinary.mkdir()
    assert path.stat().st_mode == ordinary.stat().st_mode


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "model").mkdir()
    with write_folder(tmp_path / "model", is_ours=lambda _: False) as temporary:
        fill(temporary, "x")
    assert names(tmp_path / "model") == {"manifest.json", "arrays"}


@pytest.mark.parametrize("existing", [True, False])
@pytest.mark.parametrize("failure", [RuntimeError("x"), KeyboardInterrupt(), NO_SPACE])
def test_a_failure_leaves_the_old_folder(tmp_path, existing, failure):
    path = tmp_path / "model"
    if existing:
        path.mkdir()
        fill(path, "old")
    expected = DfsmError if isinstance(failure, OSError) else type(failure)
    with pytest.raises(expected):
        half_a_folder(path, failure)
    assert names(tmp_path) == ({"model"} if existing else set())
    if existing:
        assert (path / "arrays").read_text() == "old"


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), NO_SPACE])
def test_a_failure_between_the_renames_puts_the_old_folder_back(tmp_path, monkeypatch, failure):
    path = tmp_path / "model"
    path.mkdir()
    fill(path, "old")
    rename = Path.rename

    def once(self, target):
        if Path(target) == path and self.name != "replaced":
            raise failure
        return rename(self, target)

    monkeypatch.setattr("dfsm.core.exchange.swap", lambda *_: False)  # as on other systems
    monkeypatch.setattr(Path, "rename", once)
    with pytest.raises((DfsmError, KeyboardInterrupt)):
        new_folder(path)
    assert (path / "manifest.json").read_text() == "old"
    assert names(tmp_path) == {"model"}


def test_a_foreign_folder_or_file_is_never_replaced(tmp_path):
    path = tmp_path / "results"
    path.mkdir()
    (path / "thesis.docx").write_text("years of work")
    file = tmp_path / "file"
    file.write_text("also precious")
    for target in (path, file):
        with pytest.raises(DfsmError, match="is not a folder that dfsm wrote"):
            new_folder(target)
    assert (path / "thesis.docx").read_text() == "years of work"
    assert file.read_text() == "also precious"
    with pytest.raises(DfsmError, match="could not be written"):
        new_folder(tmp_path / "nowhere" / "model")


# -- several files that belong together -----------------------------------------------------------


def results(path: Path, content: str) -> None:
    with write_together(path) as folder:
        for name in ("figures.json", "page.html"):
            (folder / name).write_text(content)


def test_results_are_replaced_beside_what_else_is_there(tmp_path):
    path = tmp_path / "deep" / "out"
    results(path, "one")
    (path / "notes.txt").write_text("mine")
    (path / ".hidden").write_text("a system's")
    (path / "runs" / "old").mkdir(parents=True)
    (path / "runs" / "old" / "a.outb").write_text("run")
    (path / "link").symlink_to("notes.txt")
    results(path, "two")
    assert {p.read_text() for p in path.glob("[fp]*.*")} == {"two"}
    assert (path / "notes.txt").read_text() == (path / "link").read_text() == "mine"
    assert (path / "link").is_symlink()
    assert (path / "runs" / "old" / "a.outb").read_text() == "run"
    assert names(path) == {"figures.json", "page.html", "notes.txt", ".hidden", "runs", "link"}
    assert names(path.parent) == {"out"}


def half_of_results(path: Path, failure: BaseException) -> None:
    with write_together(path) as folder:
        (folder / "figures.json").write_text("half")
        raise failure


@pytest.mark.parametrize("failure", [RuntimeError("x"), KeyboardInterrupt(), NO_SPACE])
def test_a_failure_leaves_old_results(tmp_path, failure):
    path = tmp_path / "out"
    results(path, "one")
    with pytest.raises((DfsmError, type(failure))):
        half_of_results(path, failure)
    assert {p.read_text() for p in path.iterdir()} == {"one"}
    assert names(tmp_path) == {"out"}


@pytest.mark.parametrize("why", ["the working folder", "no hard links"])
def test_results_where_a_folder_cannot_be_replaced(tmp_path, monkeypatch, why):
    path = tmp_path / "out"
    results(path, "one")
    (path / "notes.txt").write_text("mine")
    if why == "no hard links":
        monkeypatch.setattr("dfsm.core.files.os.link", lambda *_, **__: fail(errno.EPERM))
    else:
        monkeypatch.chdir(path)
        path = Path()
    stands = (tmp_path / "out").stat().st_ino
    results(path, "two")
    assert (tmp_path / "out").stat().st_ino == stands
    assert names(tmp_path / "out") == {"figures.json", "page.html", "notes.txt"}
    assert (tmp_path / "out" / "page.html").read_text() == "two"
    assert names(tmp_path) == {"out"}


def fail(number: int) -> None:
    raise OSError(number, "refused")


def test_results_that_cannot_be_written_are_refused_early(tmp_path):
    (tmp_path / "a").write_text("mine")
    with pytest.raises(DfsmError, match=r"a is a file, a folder was expected"):
        check_together(tmp_path / "a")
    (tmp_path / "out" / "sweep.json").mkdir(parents=True)
    with pytest.raises(DfsmError, match=r"sweep.json is a folder, a file name was expected"):
        check_together(tmp_path / "out", ["sweep.json"])
    check_together(tmp_path / "not" / "yet" / "there", ["sweep.json"])
    assert names(tmp_path) == {"a", "out"}
