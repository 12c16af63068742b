"""Parquet from data frames: columns of words and categories beside numbers."""

from __future__ import annotations

from decimal import Decimal

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from conftest import sentence
from dfsm.data.readers import read

TIME = 0.1 * np.arange(30)


def frame(**columns: object) -> pd.DataFrame:
    return pd.DataFrame({"Time [s]": TIME, "Power [kW]": np.cos(TIME), **columns})


@pytest.mark.parametrize("kind", ["str", "category", "object"])
def test_columns_of_words_are_left_out_and_told(tmp_path, kind):
    path = tmp_path / "a.parquet"
    site = pd.Series(["Høvsøre", *["Østerild"] * 29]).astype(kind)
    frame(site=site, yaw=np.arange(30)).to_parquet(path)
    run = read(path)
    assert run.names == ("Power", "yaw")
    assert run.channels[0].unit == "kW"
    np.testing.assert_array_equal(run["Power"], np.cos(TIME))
    assert run.notes == ("column 'site' left out: it holds words ('Høvsøre')",)
    frame(site=site).set_index("site").to_parquet(path)  # as the index
    assert read(path).names == ("Power",)


def test_columns_that_hold_neither_words_nor_numbers(tmp_path):
    path = tmp_path / "a.parquet"
    table = pa.table(
        {
            "t": TIME,
            "spectrum": [[1.0, 2.0]] * 30,
            "remark": pa.nulls(30),
            "sensor": pa.array(["  "] + [None] * 29),
            "x": np.sin(TIME),
        }
    )
    pq.write_table(table, path)
    run = read(path)
    assert run.names == ("x",)
    assert [n.split("holds ")[1] for n in run.notes] == [
        "list<element: double>, no numbers",
        "no values",
        "words ('  ')",
    ]


def test_categories_of_numbers_and_decimal_numbers_are_numbers(tmp_path):
    path = tmp_path / "a.parquet"
    cost = [Decimal(k) / 4 for k in range(30)]
    frame(case=pd.Categorical(np.arange(30) % 3), cost=cost).to_parquet(path)
    run = read(path)
    np.testing.assert_array_equal(run["case"], np.arange(30) % 3)
    np.testing.assert_array_equal(run["cost"], np.arange(30) / 4)
    assert run.notes == ()


def test_a_time_of_words_is_refused(tmp_path):
    path = tmp_path / "a.parquet"
    data = pd.DataFrame({"Time": [f"{t:.1f} s" for t in TIME], "x": np.sin(TIME)})
    data.to_parquet(path)
    assert "its time 'Time' holds words ('0.0 s'), expected numbers in s" in sentence(path)
    # Another column is the time.
    data["t"] = TIME
    data.to_parquet(path)
    run = read(path)
    np.testing.assert_array_equal(run.time, TIME)
    assert run.names == ("x",)
    frame(note="later")[["Time [s]", "note"]].to_parquet(path)
    assert "column 'note' holds " in sentence(path)
    assert ", expected numbers: no other is there besides the time" in sentence(path)
