#!/bin/sh
# dymos 1.15.1 (OpenMDAO 3.45.1): a record handed to a phase with its times is stretched to the phase.
#
# `set_control_val(name, vals, time_vals)`, `set_state_val` and `interp` scale the times they are given
# to [-1, 1], whatever times the phase has: 600 s of wind given to a phase from 200 to 220 s blow within
# these 20 s, thirty times too fast, and nothing is said. The record must be cut to the phase first.
#
# Seen with a control that is its own time, recorded from 0 to 600 s: in the phase it goes from 0 to 600
# instead of 200 to 220. The script fails if this changes.
#
#   sh findings/dymos_stretched_times.sh      (needs python3 with pip, and a package index)
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check dymos==1.15.1 openmdao==3.45.1
venv/bin/python -W ignore - <<'P'
import sys

import dymos
import numpy as np
import openmdao.api as om


class Integrator(om.ExplicitComponent):
    """dx/dt = u."""

    def initialize(self):
        self.options.declare("num_nodes", types=int)

    def setup(self):
        nodes = self.options["num_nodes"]
        self.add_input("u", shape=(nodes,))
        self.add_output("rate", shape=(nodes,))
        self.declare_partials("rate", "u", rows=range(nodes), cols=range(nodes), val=1.0)

    def compute(self, inputs, outputs):
        outputs["rate"] = inputs["u"]


phase = dymos.Phase(ode_class=Integrator, transcription=dymos.Radau(num_segments=10))
phase.set_time_options(fix_initial=True, fix_duration=True)
phase.add_state("x", rate_source="rate")
phase.add_control("u", targets=["u"], opt=False)
phase.add_objective("x", loc="final")
problem, trajectory = om.Problem(reports=False), dymos.Trajectory()
trajectory.add_phase("phase", phase)
problem.model.add_subsystem("all", trajectory)
problem.setup(check=False)
phase.set_time_val(initial=200.0, duration=20.0)
record = np.linspace(0, 600, 6001)
phase.set_control_val("u", record, time_vals=record)
problem.run_model()
time, u = (problem.get_val(f"all.phase.timeseries.{n}").ravel() for n in ("time", "u"))
print(f"phase from {time[0]:g} to {time[-1]:g} s; u(t) = t goes from {u[0]:g} to {u[-1]:g}")
stretched = np.allclose(u, 30 * (time - 200), atol=1e-6)
sys.exit(0 if stretched else "a record is no longer stretched to the phase")
P
