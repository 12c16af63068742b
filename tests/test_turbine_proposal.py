"""What `init` proposes for a floating turbine, by names that all tools of the field share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dfsm.config.fit import load_config
from dfsm.config.template import write_config
from dfsm.data.readers.tables import write_table
from dfsm.data.trajectory import Channel, Trajectory

UNITS = {
    "RotWind": "m/s",
    "Wave1Elev": "m",
    "GenTq": "kN-m",
    "BldPitch1": "deg",
    "GenSpeed": "rpm",
    "TwrBsMyt": "kN-m",
    "PtfmPitch": "deg",
}
TOWER = {"TTDspFA": "m", "YawBrTDxp": "m"}
TIME = np.arange(0, 60, 0.1)


def recorded(names: list[str], seed: int = 1) -> Trajectory:
    rng = np.random.default_rng(seed)
    waves = [np.sin(f * TIME + rng.uniform(0, 6)) for f in rng.uniform(0.1, 1.0, len(names))]
    channels = tuple(Channel(n, (UNITS | TOWER)[n]) for n in names)
    return Trajectory(TIME, 10 + np.stack(waves, axis=1), channels, name="run")


@pytest.mark.parametrize("floats", [True, False])
def test_waves_act_ahead_on_hulls_that_float(tmp_path, floats):
    names = [n for n in UNITS if floats or n != "PtfmPitch"]
    write_table(recorded(names), tmp_path / "run.parquet")
    write_config([str(tmp_path / "run.parquet")], tmp_path / "config.yaml")
    settings = load_config(tmp_path / "config.yaml")[0].fit_settings()
    ahead = [f"Wave1Elev_lead{s}" for s in (2, 4, 6)] if floats else []
    assert [f.name for f in settings.features] == ["Wave1Elev_dot", *ahead]
    # Waves do the same whatever the wind, along which the rest varies.
    same = ("Wave1Elev", "Wave1Elev_dot", *ahead) if floats else ()
    assert tuple(settings.linear.constant) == same
    assert settings.linear.schedule == "RotWind"


@pytest.mark.parametrize("recorded_as", [["YawBrTDxp"], ["TTDspFA"], ["YawBrTDxp", "TTDspFA"]])
def test_the_tower_top_swings_by_either_of_its_names(tmp_path, recorded_as):
    files = [tmp_path / f"run{seed}.parquet" for seed in (1, 2)]
    for seed, file in enumerate(files):
        run = recorded([*UNITS, *recorded_as], seed)
        write_table(replace(run, time=10 * run.time), file)  # long enough to refine on
    write_config([str(file) for file in files], tmp_path / "config.yaml")
    settings = load_config(tmp_path / "config.yaml")[0].fit_settings()
    states = [(s.name, s.order) for s in settings.states]
    assert states == [("PtfmPitch", 2), (recorded_as[-1], 2), ("GenSpeed", 1)]
    assert "step: 0.25" in (tmp_path / "config.yaml").read_text()
