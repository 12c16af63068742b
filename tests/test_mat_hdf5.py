"""MAT files of v7.3 as MATLAB lays them out: arrays of structs and cells are references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dfsm.data.readers import read
from dfsm.errors import DfsmError

h5py = pytest.importorskip("h5py")

TIME = 0.05 * np.arange(60)


def marked(item: Any, kind: str) -> Any:
    item.attrs["MATLAB_class"] = np.bytes_(kind)
    return item


def put(file: Any, group: Any, name: str, value: Any) -> None:
    """A variable or field: a struct, a list (array of structs), a tuple (cells), text, numbers."""
    if isinstance(value, Mapping):
        inside = marked(group.create_group(name), "struct")
        for field, part in value.items():
            put(file, inside, field, part)
    elif isinstance(value, list):
        inside = marked(group.create_group(name), "struct")
        for field in value[0]:
            refer(file, inside, field, [struct[field] for struct in value])
    elif isinstance(value, tuple):
        marked(refer(file, group, name, value), "cell")
    elif isinstance(value, str):
        codes = np.array([[ord(c)] for c in value], dtype="u2")
        marked(group.create_dataset(name, data=codes), "char")
    else:
        marked(group.create_dataset(name, data=np.atleast_2d(value).T), "double")


def refer(file: Any, group: Any, name: str, parts: Sequence[Any]) -> Any:
    hidden = file.require_group("#refs#")
    names = []
    for part in parts:
        names.append(f"p{len(hidden)}")
        put(file, hidden, names[-1], part)
    found = np.array([hidden[n].ref for n in names], dtype=h5py.ref_dtype)
    return group.create_dataset(name, data=found[:, None])


def saved(path: Path, content: Mapping[str, object]) -> Path:
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in content.items():
            put(file, file, name, value)
    return path


def six(k: int) -> np.ndarray:
    return np.cos(np.outer(TIME, k + np.arange(6)))


def test_wecsim_with_several_bodies(tmp_path):
    bodies = [
        {"name": f"body {k}", "time": TIME[:, None], "position": six(k), "forceTotal": six(k + 3)}
        for k in (1, 2, 3)
    ]
    wave = {"time": TIME[:, None], "elevation": np.sin(TIME)[:, None]}
    run = read(saved(tmp_path / "a.mat", {"output": {"bodies": bodies, "wave": wave}}))
    assert len(run.names) == 3 * 12 + 1
    np.testing.assert_array_equal(run["bodies_3.position_5"], six(3)[:, 4])
    np.testing.assert_array_equal(run["bodies_2.forceTotal_1"], six(5)[:, 0])
    units = {c.name: c.unit for c in run.channels}
    assert [units[f"bodies_1.position_{i}"] for i in (3, 4)] == ["m", "rad"]
    assert units["wave.elevation"] == "m"
    assert run.notes == ()


def test_structs_in_structs_and_cells(tmp_path):
    column = TIME[:, None]
    blades = [
        {"root": {"M": column * k}, "tips": [{"d": column + k}, {"d": column - k}]} for k in (1, 2)
    ]
    content = {
        "time": column,
        "blade": blades,
        "cases": ({"x": column**2}, {"x": column**3}),
        "words": ("Mx", "", "Mz"),
        "mixed": (column, "text"),
    }
    run = read(saved(tmp_path / "a.mat", content))
    assert run.names == (
        "blade_1.root.M",
        "blade_1.tips_1.d",
        "blade_1.tips_2.d",
        "blade_2.root.M",
        "blade_2.tips_1.d",
        "blade_2.tips_2.d",
        "cases_1.x",
        "cases_2.x",
    )
    np.testing.assert_array_equal(run["blade_2.tips_2.d"], TIME - 2)
    np.testing.assert_array_equal(run["cases_2.x"], TIME**3)
    assert [n.split(" left out")[0] for n in run.notes] == ["'mixed'", "'words'"]


def test_references_that_lead_nowhere_or_in_circles(tmp_path):
    path = saved(tmp_path / "a.mat", {"time": TIME[:, None], "y": TIME[:, None] ** 2})
    raw = path.read_bytes()
    with h5py.File(path, "a") as file:
        empty = np.array([h5py.Reference(), file["y"].ref], dtype=h5py.ref_dtype)
        part = marked(file.create_group("part"), "struct")
        part.create_dataset("x", data=empty[:, None])
    run = read(path)
    assert run.names == ("part_2.x", "y")
    assert run.notes[0].startswith("'part_1.x' left out: it is")
    path.write_bytes(raw)
    with h5py.File(path, "a") as file:
        part = marked(file.create_group("part"), "struct")
        part.create_dataset("x", data=np.array([[part.ref]] * 2, dtype=h5py.ref_dtype))
    with pytest.raises(DfsmError, match="its parts are too many or nested too deeply"):
        read(path)
