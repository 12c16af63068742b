"""Run the measurements and print one JSON object.

python -m benchmarks [derivatives] [accuracy] [speed] [parameters] [scaling] [rollouts] [unseen]
    [limits] [matched] [control] [codesign] [peer]

Without names all but `peer`, which makes an environment of its own and installs jax-sysid there.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import warnings

import dfsm
from benchmarks import (
    accuracy,
    codesign,
    control,
    derivatives,
    limits,
    matched,
    parameters,
    peer,
    rollouts,
    scaling,
    speed,
    unseen,
)
from dfsm.core.files import json_value

PARTS = {
    "derivatives": derivatives.run,
    "accuracy": accuracy.run,
    "speed": speed.run,
    "parameters": parameters.run,
    "scaling": scaling.run,
    "rollouts": rollouts.run,
    "unseen": unseen.run,
    "limits": limits.run,
    "matched": matched.run,
    "control": control.run,
    "codesign": codesign.run,
    "peer": peer.run,
}


def main() -> None:
    """Run the parts named on the command line, or all but the peer."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"of {', '.join(PARTS)}")
    names = parser.parse_args().parts or [n for n in PARTS if n != "peer"]
    unknown = [n for n in names if n not in PARTS]
    if unknown:
        parser.error(f"no part '{unknown[0]}'; choose from {', '.join(PARTS)}")
    figures: dict[str, object] = {
        "dfsm": dfsm.__version__,
        "python": platform.python_version(),
        "processors": os.cpu_count(),
    }
    warnings.simplefilter("ignore", dfsm.DfsmWarning)
    for name in names:
        figures[name] = PARTS[name]()
    print(json.dumps(json_value(figures), indent=2))


if __name__ == "__main__":
    main()
