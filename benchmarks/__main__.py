"""Run the measurements and print one JSON object.

python -m benchmarks [derivatives] [field] [accuracy] [speed] [parameters] [scaling] [rollouts]
    [unseen] [waves] [limits] [intervals] [matched] [control] [codesign] [loops] [tuning] [exports]
    [hidden] [sysid] [peer] [dymos] [gpu] [fuzz] [kill] [feedback] [memory]

Without names all but `sysid`, which fits with five seeds (``sysid --data FOLDER`` for published
records), `peer` and `dymos`, which make environments of their own and install jax-sysid and dymos
there, and `fuzz` and `kill`, which damage inputs and end commands for hours
(``fuzz --inputs 20000``).
``[startup] [--before COMMIT]`` measures cold processes, of an earlier build beside this one, and
`install` the size of the environment.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import warnings
from collections.abc import Callable
from typing import Any

import dfsm
from benchmarks import (
    accuracy,
    codesign,
    control,
    derivatives,
    dymos_peer,
    exports,
    feedback,
    field,
    fuzz,
    gpu,
    hidden_turbine,
    install,
    intervals,
    kill,
    limits,
    loops,
    matched,
    memory,
    parameters,
    peer,
    rollouts,
    scaling,
    speed,
    startup,
    sysid,
    tuning,
    unseen,
    waves,
)
from dfsm.core.files import json_value

PARTS: dict[str, Callable[..., object]] = {
    "derivatives": derivatives.run,
    "field": field.run,
    "feedback": feedback.run,
    "accuracy": accuracy.run,
    "speed": speed.run,
    "startup": startup.run,
    "memory": memory.run,
    "install": install.run,
    "parameters": parameters.run,
    "scaling": scaling.run,
    "rollouts": rollouts.run,
    "unseen": unseen.run,
    "waves": waves.run,
    "limits": limits.run,
    "intervals": intervals.run,
    "matched": matched.run,
    "control": control.run,
    "codesign": codesign.run,
    "loops": loops.run,
    "tuning": tuning.run,
    "exports": exports.run,
    "hidden": hidden_turbine.run,
    "sysid": sysid.run,
    "peer": peer.run,
    "dymos": dymos_peer.run,
    "gpu": gpu.run,
    "fuzz": fuzz.run,
    "kill": kill.run,
}
# Run where they are named alone.
NAMED = ("sysid", "memory", "peer", "dymos", "fuzz", "kill")


def main() -> None:
    """Run the parts named on the command line, or all that take minutes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"of {', '.join(PARTS)}")
    parser.add_argument("--inputs", type=int, default=20_000, help="of fuzz")
    parser.add_argument("--before", metavar="COMMIT", help="of startup: an earlier build")
    parser.add_argument("--data", help="folder with the published records of sysid")
    parser.add_argument("--seed", type=int, default=0, help="of fuzz")
    arguments = parser.parse_args()
    names = arguments.parts or [n for n in PARTS if n not in NAMED]
    unknown = [n for n in names if n not in PARTS]
    if unknown:
        parser.error(f"no part '{unknown[0]}'; choose from {', '.join(PARTS)}")
    figures: dict[str, Any] = {
        "dfsm": dfsm.__version__,
        "python": platform.python_version(),
        "processors": os.cpu_count(),
    }
    warnings.simplefilter("ignore", dfsm.DfsmWarning)
    for name in names:
        told = {
            "fuzz": (arguments.inputs, arguments.seed),
            "startup": (arguments.before,),
            "sysid": (arguments.data,),
        }
        figures[name] = PARTS[name](*told.get(name, ()))
        tables = {
            "intervals": intervals.intervals_table,
            "waves": waves.waves_table,
            "startup": startup.startup_table,
            "memory": memory.memory_table,
            "install": install.install_table,
            "hidden": hidden_turbine.hidden_turbine_table,
        }
        if name in tables:
            print("\n".join(tables[name](figures[name])), file=sys.stderr)
    print(json.dumps(json_value(figures), indent=2))


if __name__ == "__main__":
    main()
