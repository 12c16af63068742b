"""Notebooks run as scripts on the bundled data, from their own folder as Jupyter does."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "notebooks").glob("*.py"))


def test_each_is_paired_listed_and_thin():
    listed = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    assert len(SCRIPTS) == 3
    for path in SCRIPTS:
        text = path.read_text(encoding="utf-8")
        assert "formats: ipynb,py:percent" in text
        assert "\n# %% [markdown]\n# # " in text
        assert f"({path.name})" in listed
        assert len(text.splitlines()) < 110


@pytest.mark.notebook
@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_it_runs(path, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(path))
