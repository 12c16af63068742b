"""docs/tuning.md: its Python runs, its YAML has the keys that there are."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dfsm.config.tune import load_tuning

TEXT = (Path(__file__).parents[1] / "docs" / "tuning.md").read_text(encoding="utf-8")


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_the_page_runs_from_top_to_bottom(capsys):
    blocks = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(compile("\n".join(blocks), "tuning.md", "exec"), {})
    assert "std of GenSpeed" in capsys.readouterr().out


def test_the_configuration_on_the_page_is_one(tmp_path):
    (block,) = re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)
    (tmp_path / "tune.yaml").write_text(block, encoding="utf-8")
    assert load_tuning(tmp_path / "tune.yaml").constraints[0].reference == 7.56
