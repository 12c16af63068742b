"""docs/tuning.md: its Python runs, its YAML has the keys that there are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dfsm.config.sweep import load_sweep
from dfsm.config.tune import load_tuning

TEXT = (Path(__file__).parents[1] / "docs" / "tuning.md").read_text(encoding="utf-8")


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_the_page_runs_from_top_to_bottom(capsys):
    blocks = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(compile("\n".join(blocks), "tuning.md", "exec"), {})
    assert "std of GenSpeed" in capsys.readouterr().out


def test_the_configuration_on_the_page_is_one(tmp_path):
    block, other = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "sweep.yaml").write_text(other, encoding="utf-8")
    assert load_sweep(tmp_path / "sweep.yaml").settings(60.0).rated_speed == 7.56
    (tmp_path / "tune.yaml").write_text(block, encoding="utf-8")
    assert load_tuning(tmp_path / "tune.yaml").constraints[0].reference == 7.56
