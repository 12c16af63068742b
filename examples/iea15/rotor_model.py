"""One model for all winds that holds the rotor's table, and what it does at winds it never saw.

The demo's model learns from runs what the rotor does, and is right at the mean winds of its runs.
Here the table of the rotor's thrust and torque is part of the linear fit, wind and blade pitch
reach it relative to the moving hub, and what runs add is small and the same at all winds. From the
wind field come averages over rings of the rotor, of which refinement learns how much each counts.
Trained at 6, 12 and 18 m/s as the demo, tested at 8, 10, 14 and 16 m/s, too.

    python examples/iea15/rotor_model.py [--output out/]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import demo  # its neighbour
import dfsm
from dfsm.cli.tables import print_validations
from dfsm.errors import hushed

WINDS = demo.WINDS["all winds"]
# Mean winds between those that train, and runs there with perturbed controls.
BETWEEN = ("08mps_s01", "10mps_s01", "14mps_s01", "16mps_s01")
BETWEEN_PERTURBED = ("10mps_s01_ol", "14mps_s01_ol")
RINGS = ("U_r015", "U_r036", "U_r057", "U_r078", "U_r099", "U_r116", "U_cubic")
# What moves the platform besides the rotor, by the equation of motion in pitch.
HYDRODYNAMICS = (
    *("PtfmPitch", "PtfmPitch_dot", "Wave1Elev", "Wave1Elev_dot"),
    *("RotShearV", "RotShearH"),
)


def with_rings(runs: Sequence[dfsm.Trajectory]) -> list[dfsm.Trajectory]:
    """Runs with the wind over rings of the rotor, as ``dfsm wind`` adds it from a field."""
    winds = []
    for run in runs:
        wind, seed = run.name.split("_")[2:4]
        path = demo.DATA / "winds" / f"iea15_{wind}_{seed}.parquet"
        winds.append(dfsm.with_harmonics(run, dfsm.read(path)))
    return winds


def between(stems: Sequence[str]) -> list[dfsm.Trajectory]:
    """Runs at mean winds at which none trains."""
    return dfsm.read_all([demo.DATA / f"iea15_2dof_{stem}.parquet" for stem in stems])


def rotor(rings: Sequence[str] = RINGS) -> dfsm.Rotor:
    """The rotor of this turbine on its platform."""
    return dfsm.Rotor(
        table=demo.DATA / "Cp_Ct_Cq.IEA15MW.txt",
        radius=120.97,
        wind="RotWind",
        speed="GenSpeed",
        pitch="BldPitch1",
        hub_height=demo.HUB_HEIGHT,
        pitch_rate="PtfmPitch_dot",
        corrections=tuple(f"{ring}-RotWind" for ring in rings),
        inertia=318.6e6,  # with the generator
        generator_torque="GenTq",
        induction="lag",
        memory="wind",
        uncertainty=0.1,
    )


def settings(rings: Sequence[str] = RINGS) -> dfsm.FitSettings:
    """The demo's signals; the rotor's table instead of coefficients that vary with the wind."""
    full = demo.refined_settings()
    excess = (dfsm.Feature(source=r, kind="difference", less="RotWind") for r in rings)
    return replace(
        full,
        features=(*full.features, *excess),
        terms=(rotor(rings),),
        corrected=full.outputs,
        linear=dfsm.LPV(
            schedule="RotWind",
            points=9,
            margin=0.01,
            only={"PtfmPitch": ("rotor.thrust", "rotor.torque", *HYDRODYNAMICS)},
        ),
    )


# As the demo's, but for the network: the table does its work. What is remembered is wind and waves
# alone, not the controller's answer to them, so that the model holds for other controls.
REFINEMENT = replace(
    demo.REFINEMENT,
    network=0,
    latent_inputs=(
        *("RotWind", "RotShearV", "RotShearH", "Wave1Elev", "Wave1Elev_dot"),
        *(f"{ring}-RotWind" for ring in RINGS),
    ),
)


def main() -> None:
    """Fit, validate on unseen seeds, perturbed controls and winds, and print the table."""
    parser = argparse.ArgumentParser(description="A model that holds the rotor's table.")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the model")
    output: Path = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    with dfsm.show_progress(), hushed():
        training = with_rings([*demo.runs(WINDS, range(1, 9)), *demo.perturbed(testing=False)])
        fitted = dfsm.fit(training, settings(), REFINEMENT)
        dfsm.save(fitted.model, output / "model_rotor")
        tests = {
            "seeds 9 and 10": demo.runs(WINDS, range(9, 11)),
            "perturbed controls": demo.perturbed(testing=True),
            "winds between": between(BETWEEN),
            "winds between, perturbed": between(BETWEEN_PERTURBED),
        }
        validations = {
            label: dfsm.validate(fitted.model, with_rings(runs), start=demo.START)
            for label, runs in tests.items()
        }
    print_validations(validations)


if __name__ == "__main__":
    main()
