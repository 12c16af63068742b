"""docs/closed-loop.md runs as it stands."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "closed-loop.md"


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    own = next(b for b in blocks if "class Mine" in b).split("class Mine")[1].split("\n\n\n")[0]
    assert len(own.splitlines()) < 20
    # Dataclasses look the module of their class up.
    page = types.ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)
    exec(compile("\n".join(blocks), str(PAGE), "exec"), vars(page))
    assert "completed" in capsys.readouterr().out
