"""The README: its example runs, its commands and links exist, the first result is on one screen."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from dfsm.cli import app
from dfsm.config.template import write_config

ROOT = Path(__file__).parents[1]
DATA = ROOT / "examples" / "iea15"


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
def test_python_example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = (ROOT / "README.md").read_text(encoding="utf-8").split("```python")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) < 10
    for folder, speed in (("runs", "06"), ("runs", "12"), ("test", "18")):
        (tmp_path / folder).mkdir(exist_ok=True)
        name = f"iea15_2dof_{speed}mps_s09.outb"
        shutil.copy(DATA / name, tmp_path / folder / name)
    monkeypatch.chdir(tmp_path)
    write_config(["runs/*.outb"], Path("config.yaml"))
    exec(compile(code, "README.md", "exec"), {})
    assert "my turbine" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_the_shell_commands_exist() -> None:
    names = {c.name or c.callback.__name__ for c in app.registered_commands if c.callback}
    names |= {group.name for group in app.registered_groups if group.name}
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    used = {line.split()[1] for line in text.splitlines() if line.startswith("    dfsm ")}
    told = re.search(r"More commands: (.*?) From Python:", text, re.DOTALL)
    assert told is not None
    used |= set(re.findall(r"`([a-z-]+)`", told[1]))
    assert used
    assert used <= names


def test_the_first_result_is_on_one_screen() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert lines.index("    dfsm validate model/ test/*.outb -o report.html") < 40
    assert sum("![" in line for line in lines) == 1
