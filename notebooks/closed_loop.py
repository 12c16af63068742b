# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # A controller in the loop
#
# Put a controller on a fitted model, and it answers what the turbine does under that controller. The
# model is fitted to runs in which torque and pitch were moved on their own; the controller is a PI of
# the rotor speed on blade pitch, with three gains.

# %%
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp

import dfsm

DATA = next(p for p in (Path("examples/iea15"), Path("../examples/iea15")) if p.is_dir())
runs = dfsm.read_all([DATA / f"iea15_2dof_18mps_s0{seed}_ol.parquet" for seed in (1, 2)])
wind = dfsm.read(DATA / "iea15_2dof_18mps_s10.parquet").window(100.0, 400.0)
settings = dfsm.FitSettings(
    states=(
        dfsm.StateSpec(name="PtfmPitch", order=2, rate="PtfmRVyt"),
        dfsm.StateSpec(name="GenSpeed"),
    ),
    controls=("GenTq", "BldPitch1"),
    disturbances=("RotWind", "RotShearV", "Wave1Elev"),
    linear=dfsm.LTI(margin=0.04, known={"GenSpeed": {"GenTq": -2.997e-5}}),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
    start=100.0,
)
model = dfsm.fit(runs, settings).model

# %% [markdown]
# Blade pitch rises with the speed above its set-point, in the units that the controller says.

# %%
pi = dfsm.PID(
    kp=-1.5,
    ki=-0.12,
    setpoint=7.56,
    limits=(0.0, 22.6),
    measurements=["GenSpeed"],
    measurement_units=["rpm"],
    commands=["BldPitch1"],
    command_units=["deg"],
    interval=0.1,
)
loops = {
    gain: dfsm.closed_loop(model, wind, replace(pi, kp=jnp.array(gain)))
    for gain in (-0.7, -1.5, -3.0)
}
for gain, loop in loops.items():
    run = loop.trajectory
    spread = {
        name: round(float(run[name].std()), 3) for name in ("GenSpeed", "BldPitch1", "PtfmPitch")
    }
    print(f"kp {gain:g}: {loop.status.name.lower()}, standard deviations {spread}")

# %% [markdown]
# A higher gain holds the speed better and moves the blades more. `dfsm.sweep` makes tables of many
# controllers over many runs, `dfsm.prepare_loop` gives gradients with respect to gains, and
# `dfsm closed-loop` does the same with ROSCO from its DISCON.IN.

# %%
speeds = [loop.trajectory["GenSpeed"].std() for loop in loops.values()]
assert speeds[0] > speeds[1] > speeds[2]
