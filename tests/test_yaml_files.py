"""Configurations as people save them: other letters, decimal commas, true for a number."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from conftest import CONFIG, changed, write_config
from dfsm.config.control import ControlConfig
from dfsm.config.fit import parse_candidates, parse_config
from dfsm.config.parse import parse_file
from dfsm.errors import DfsmError

PROBLEM = """
model: m/
disturbances: wind.csv
horizon: [0, 10]
cost:
  - {square: q, weight: 2}
  - {square: u, weight: COST}
bounds: {u: [-1, 1]}
initial: recorded
"""


def said(path: Path) -> str:
    with pytest.raises(DfsmError) as caught:
        parse_config(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_comments_and_names_in_any_letters(tmp_path, encoding, end):
    path = write_config(tmp_path / "c.yaml", CONFIG)
    dash = "\u2013" if encoding not in ("latin-1",) else "-"
    text = f"# für die Größe {dash} Ørsted\n{path.read_text()}".replace("a.csv", "größe.csv")
    path.write_bytes(text.replace("\n", end).encode(encoding))
    config = parse_config(path)
    assert config.data.train[0].endswith("größe.csv")
    assert config.corrective == parse_config(write_config(tmp_path / "d.yaml", CONFIG)).corrective


def test_what_is_no_text_is_told(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_bytes(b"\x93\x00NUMPY\x01\x00")
    assert said(path).startswith(f"{path} is not valid YAML (it is no text): ")


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("1,5", "line 6: 1,5 has a decimal comma, which parts keys here: write 1.5"),
        ("-0,05", "line 6: -0,05 has a decimal comma"),
        ("3,2e1", "line 6: 3,2e1 has a decimal comma"),
        ("1, 5", "keys should be strings"),
        ("true", "'cost[1].weight': a number was expected, not true"),
    ],
)
def test_decimal_commas_and_truths_in_a_problem(tmp_path, written, expected):
    path = tmp_path / "p.yaml"
    path.write_text(PROBLEM.lstrip("\n").replace("COST", written))
    with pytest.raises(DfsmError) as caught:
        parse_file(path, ControlConfig, "write one")
    assert expected in str(caught.value)
    path.write_text(PROBLEM.replace("COST", "1.5"))
    assert parse_file(path, ControlConfig, "write one").cost[1].weight == 1.5


def test_true_is_no_number(tmp_path):
    path = tmp_path / "c.yaml"
    for keys, value in {("gate",): True, ("seed",): False, ("data", "step"): True}.items():
        write_config(path, changed(*keys, value=value))
        where, shown = ".".join(keys), str(value).lower()
        assert f"'{where}': a number was expected, not {shown}" in said(path)
    write_config(path, changed("gate", value="0,02"))
    assert "not '0,02', which has a decimal comma: write a point" in said(path)
    # Where true and false are meant.
    write_config(path, changed("nonlinear_only", value=True))
    assert parse_config(path).nonlinear_only is True
    candidates: dict[str, Any] = copy.deepcopy(CONFIG)
    candidates["compare"] = {"hold_out": 0.3, "candidates": {"wide": {"gate": True}}}
    write_config(path, candidates)
    with pytest.raises(DfsmError, match=r"wide: 'gate': a number was expected, not true"):
        parse_candidates(path)
