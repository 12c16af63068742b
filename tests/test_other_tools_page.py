"""docs/with-other-tools.md runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "with-other-tools.md"


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_runs_from_top_to_bottom(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile("\n".join(blocks), str(PAGE), "exec"), {})
    told = capsys.readouterr().out
    assert "8.5 True steady state" in told
    assert "RotSpeed" in told
    assert (tmp_path / "turbine.mat").exists()
