"""The bundled OpenFAST runs of the IEA 15 MW floating turbine, and what their signals stand for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import dfsm
from dfsm.data.readers import with_wall_times

DATA = Path(__file__).parent
START = 100.0  # s, the start-up transient before it is dropped
HUB_HEIGHT = 150.0  # m
ALL_WINDS = ["06", "12", "18"]  # mean wind speeds in m/s as in the names of files
# The paper's controls and outputs; wind as disk average and slopes, and the waves.
CONTROLS = ("GenTq", "BldPitch1")
DISTURBANCES = ("RotWind", "RotShearV", "RotShearH", "Wave1Elev")
OUTPUTS = ("TwrBsFxt", "TwrBsMyt", "GenPwr")
AZIMUTH = dfsm.Azimuth(speed="GenSpeed", angle="LSSTipPxa")
PERTURBED = {
    False: ("06mps_s01", "12mps_s01", "12mps_s02", "12mps_s03", "18mps_s01"),
    True: ("06mps_s02", "12mps_s04", "18mps_s02"),
}
# Mean winds between those that train, and runs there with perturbed controls.
BETWEEN = ("08mps_s01", "10mps_s01", "14mps_s01", "16mps_s01")
BETWEEN_PERTURBED = ("10mps_s01_ol", "14mps_s01_ol")


def runs(winds: Sequence[str], seeds: range) -> list[dfsm.Trajectory]:
    """Closed-loop runs, with the wall time that OpenFAST took for each."""
    stems = [f"iea15_2dof_{wind}mps_s{seed:02d}" for wind in winds for seed in seeds]
    runs = dfsm.read_all([next(DATA.glob(f"{stem}.[op]*")) for stem in stems])
    return with_wall_times(runs, DATA / "wall_times.json")


def perturbed(testing: bool) -> list[dfsm.Trajectory]:
    """Runs whose torque and pitch do not follow the controller: five to train, three to test."""
    stems = [f"iea15_2dof_{which}_ol" for which in PERTURBED[testing]]
    return dfsm.read_all([next(DATA.glob(f"{stem}.[op]*")) for stem in stems])


def between(stems: Sequence[str]) -> list[dfsm.Trajectory]:
    """Runs at mean winds at which none trains."""
    return dfsm.read_all([DATA / f"iea15_2dof_{stem}.parquet" for stem in stems])


def with_rings(runs: Sequence[dfsm.Trajectory]) -> list[dfsm.Trajectory]:
    """Runs with the wind over rings of the rotor, as ``dfsm wind`` adds it from a field."""
    winds = []
    for run in runs:
        wind, seed = run.name.split("_")[2:4]
        path = DATA / "winds" / f"iea15_{wind}_{seed}.parquet"
        winds.append(dfsm.with_harmonics(run, dfsm.read(path)))
    return winds
