# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # Optimal control of a fitted model
#
# Which torque and blade pitch give the most power over two minutes of known wind, if the platform may
# not pitch beyond a limit? The model is fitted to runs in which torque and pitch were moved on their
# own, so that it knows what they do; the inertia of the rotor is known (`linear.known`).

# %%
from pathlib import Path

import dfsm

DATA = next(p for p in (Path("examples/iea15"), Path("../examples/iea15")) if p.is_dir())
runs = dfsm.read_all([DATA / f"iea15_2dof_12mps_s0{seed}_ol.parquet" for seed in (1, 2, 3)])
wind = dfsm.read(DATA / "iea15_2dof_12mps_s10.parquet")
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
# The sign of what a control does is worth a look before an optimizer makes use of it: torque and blade
# pitch both slow the rotor down.

# %%
point = dfsm.steady_state(model, controls=[18e3, 6.0], disturbances=[12.0, 1.5, 0.0])
A, B, *_ = model.jacobians(point.states, point.controls, point.disturbances)
speed = model.signals.names("states").index("GenSpeed")
print("rotor speed over torque and blade pitch:", B[speed, :2])
assert (B[speed, :2] < 0).all()


# %% [markdown]
# Costs are functions of named signals, bounds are pairs. Power is torque times speed, in MW here; small
# quadratic terms keep the controls smooth, as in the paper (its Eq. 17).


# %%
def cost(s):
    """Minus the power, in MW, and the price of moving."""
    torque = s.u.GenTq / 1e3
    power = torque * s.x.GenSpeed * 0.10472
    return -power + 1e-5 * torque**2 + 0.005 * s.u.BldPitch1**2


def solved(most_pitch):
    """The optimum with a limit on the platform's pitch in deg."""
    problem = dfsm.OptimalControlProblem(
        model=model,
        horizon=(300.0, 420.0),
        cost=cost,
        bounds={
            "GenTq": (15e3, 19.9e3),
            "BldPitch1": (0.0, 15.0),
            "GenSpeed": (6.5, 7.56),
            "PtfmPitch": (-1.0, most_pitch),
        },
        rates={"BldPitch1": (-2.0, 2.0), "GenTq": (-1e3, 1e3)},
        disturbances=wind,
    )
    method = dfsm.DirectTranscription(scheme="trapezoidal", mesh=120, refine=None)
    return dfsm.solve(problem, method)


solutions = {limit: solved(limit) for limit in (6.0, 4.0)}
for limit, solution in solutions.items():
    print(f"pitch up to {limit:g} deg:", solution)

# %% [markdown]
# A lower limit costs power. What the optimum is worth on the true turbine, `dfsm export-rosco` and
# `dfsm check-run` find out.

# %%
assert solutions[4.0].objective > solutions[6.0].objective
dfsm.save_solution(solutions[4.0], "result")
