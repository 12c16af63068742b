# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From own data to a report
#
# Three recorded runs of a floating wind turbine train a model, a fourth tests it. Put your own files
# and channels in the place of these; `dfsm info` and `dfsm init` tell what your files hold.

# %%
from pathlib import Path

import dfsm

DATA = next(p for p in (Path("examples/iea15"), Path("../examples/iea15")) if p.is_dir())
runs = dfsm.read_all([DATA / f"iea15_2dof_12mps_s0{seed}.parquet" for seed in (1, 2, 3)])
test = dfsm.read_all([DATA / "iea15_2dof_12mps_s10.parquet"])
print(runs[0])

# %% [markdown]
# What is what: the platform's pitch moves (order 2, its rate is recorded), the rotor's speed is a
# state of its own. Torque and blade pitch are controls; wind and waves are disturbances.
#
# The margin keeps modes stable that least squares leaves undamped.

# %%
settings = dfsm.FitSettings(
    states=(
        dfsm.StateSpec(name="PtfmPitch", order=2, rate="PtfmRVyt"),
        dfsm.StateSpec(name="GenSpeed"),
    ),
    controls=("GenTq", "BldPitch1"),
    disturbances=("RotWind", "RotShearV", "Wave1Elev"),
    outputs=("TwrBsMyt",),
    linear=dfsm.LTI(margin=0.04),
    corrective=dfsm.NoCorrection(),
    nonlinear_only=False,
    start=100.0,
)
result = dfsm.fit(runs, settings)
print(result.model.summary())

# %% [markdown]
# Test it on the run that it has never met: 600 s from the recorded state, driven by the recorded
# inputs. An error of 0 is perfect, 1 is as good as a constant.

# %%
validation = dfsm.validate(result.model, test, start=100.0)
for channel in ("PtfmPitch", "GenSpeed", "TwrBsMyt"):
    print(channel, validation.mean_nrmse("multi-fidelity", channel))

# %% [markdown]
# Keep the model, and write a page that needs no server. Refinement on rollouts (`refine`) makes the
# model several times more accurate, in minutes.

# %%
dfsm.save(result.model, "model")
dfsm.write_report({"12 m/s": validation}, "report.html")
