#!/bin/sh
# FMPy 0.3.32, `simulate_fmu(…, set_input_derivatives=True)`: derivatives of inputs are told to an FMU
# of FMI 2 that has exactly nine real inputs, and are those of the interval that has just ended.
#
# `Input` allocates nine numbers for the derivatives whatever the number of inputs, and ctypes refuses
# an assignment of any other length: "Can only assign sequence of same size". With nine, `interpolate`
# looks for the sample left of the time: at a sample, where the next communication step begins, that
# is the interval before. An input that goes 0, 1, 0 at 0, 1, 2 s has the slopes 1 and -1 there; told
# are 0 and 1. An FMU that follows them is a sample late, which is worse than an input that is held.
#
# Seen with 0.3.32. The script fails if it changes.
#
#   sh findings/fmpy_input_derivatives.sh      (needs python3 with pip, and a package index)
set -eu
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check fmpy==0.3.32
venv/bin/python - <<'P'
import sys

import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.model_description import ModelDescription, ScalarVariable
from fmpy.simulation import Input


class Listening(FMU2Slave):
    """An FMU that keeps what it is told."""

    component = None
    fmi2SetReal = fmi2SetInteger = fmi2SetBoolean = lambda *_: 0

    def __init__(self):
        self.told = []

    def fmi2SetRealInputDerivatives(self, component, references, count, orders, values):
        self.told.append(list(values))


def told(count):
    """Derivatives of all inputs where communication steps begin, or the error."""
    names, about = [f"u{k}" for k in range(count)], ModelDescription()
    for k, name in enumerate(names):
        variable = ScalarVariable(name=name, valueReference=k)
        variable.type, variable.causality, variable.variability = "Real", "input", "continuous"
        about.modelVariables.append(variable)
    kind = [("time", float), *((name, float) for name in names)]
    samples = np.array([(t, *[u] * count) for t, u in ((0, 0), (1, 1), (2, 0))], dtype=kind)
    fmu = Listening()
    inputs = Input(fmu, about, samples, set_input_derivatives=True)
    try:
        for time in (0.0, 1.0):
            inputs.apply(time)
    except ValueError as error:
        return str(error)
    return [row[0] for row in fmu.told]


found = {count: told(count) for count in (1, 2, 8, 9, 10)}
for count, what in found.items():
    print(f"{count} inputs: {what}")
refused = all("same size" in found[count] for count in (1, 2, 8, 10))
sys.exit(0 if refused and found[9] == [0.0, 1.0] else "derivatives are told otherwise now")
P
