"""ROSCO in JAX on the rotor model, against OpenFAST's closed-loop runs of the same turbine.

The deck is that of the runs: IEA-15-240-RWT-UMaineSemi_DISCON.IN of the rosco wheel, 2.10.6, with
the table of the rotor that it names. The model comes from rotor_model.py. Folders of runs with
other gains (``iea15_2dofgA_14mps_s01.outb``) are compared by what the change of gains does.

    python examples/iea15/closed_loop.py DISCON.IN [--model out/model_rotor] [--gains folder]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import dfsm
from dfsm.cli.tables import print_article
from dfsm.errors import hushed
from dfsm.loops.load_cases import Figures
from dfsm.report.closed_loop_article import closed_loop_article
from turbine_runs import ALL_WINDS, DATA, START, runs, with_rings

# The nacelle is rigid in this model: it turns with the platform.
MEASUREMENTS = {"NcIMURAys": "PtfmPitch_dot_dot"}
# Factors of PC_GS_KP, PC_GS_KI and Fl_Kp by the letter in a file's name.
GAINS = {"A": (0.6, 0.6, 1.0), "B": (1.7, 1.7, 1.0), "C": (1.0, 1.0, 0.0), "D": (1.3, 2.0, 0.5)}
STATISTICS = ("GenSpeed", "PtfmPitch", "BldPitch1", "GenPwr")


def changed(deck: dfsm.ROSCO, letter: str) -> dfsm.ROSCO:
    """The deck's controller with the gains of a folder's runs."""
    keys = ("PC_GS_KP", "PC_GS_KI", "Fl_Kp")
    factors = zip(keys, GAINS[letter], strict=True)
    return deck.changed({key: factor * deck.parameters[key] for key, factor in factors})


def spread(run: dfsm.Trajectory) -> np.ndarray:
    """Standard deviations, and the tower-base DEL, after the start-up."""
    run = run.window(START)
    load = Figures.of(run.time, run["TwrBsMyt"]).damage["4"]
    return np.array([*(run[name].std() for name in STATISTICS), load])


def print_changes(model: dfsm.DFSM, deck: dfsm.ROSCO, folder: Path) -> None:
    """What other gains do, relative to the deck's: OpenFAST, and the closed loop."""
    print("ratio to the deck's gains, OpenFAST → closed loop: " + ", ".join([*STATISTICS, "DEL"]))
    for path in sorted(folder.glob("iea15_2dofg?_*mps_s*.outb")):
        head, letter, tail = path.stem.partition("2dofg")[0], path.stem[11], path.stem[13:]
        base = dfsm.read(DATA / f"{head}2dof_{tail}.parquet")
        (run,) = with_rings([base])
        laws = {"deck": deck, "changed": changed(deck, letter)}
        true = spread(dfsm.read(path)) / spread(base)
        loops = [
            dfsm.closed_loop(model, run, law, start=START, measurements=MEASUREMENTS)
            for law in laws.values()
        ]
        if any(loop.status is not dfsm.LoopStatus.COMPLETED for loop in loops):
            print(path.stem, *[loop.message for loop in loops])
            continue
        first, second = (spread(loop.trajectory) for loop in loops)
        pairs = zip(true, second / first, strict=True)
        print(path.stem, "  ".join(f"{a:.2f} → {b:.2f}" for a, b in pairs))


def main() -> None:
    """Close the loop on seeds 9 and 10 and print the table."""
    parser = argparse.ArgumentParser(description="ROSCO on the rotor model.")
    parser.add_argument("deck", type=Path, help="DISCON.IN")
    parser.add_argument("--model", type=Path, default=Path("out/model_rotor"))
    parser.add_argument("--gains", type=Path, help="folder of runs with other gains")
    told = parser.parse_args()
    model = dfsm.load(told.model)
    deck = dfsm.read_rosco(told.deck, interval=0.05)
    with hushed():
        tests = with_rings(runs(ALL_WINDS, range(9, 11)))
        validation = dfsm.validate_closed_loop(
            model, tests, deck, start=START, measurements=MEASUREMENTS
        )
        article = closed_loop_article(validation, str(told.model), str(told.deck))
        print_article(replace(article, sections=article.sections[:2]))
        if told.gains is not None:
            print_changes(model, deck, told.gains)


if __name__ == "__main__":
    main()
