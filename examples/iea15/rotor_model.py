"""One model for all winds that holds the rotor's table, and what it does at winds it never saw.

The table of the rotor's thrust and torque is part of the linear fit; wind and blade pitch reach it
relative to the moving hub, the wind when it is where the rotor stands, and the induced velocity
lags behind. What runs add is small and the same at all winds. From the wind field come averages
over rings of the rotor, of which refinement learns how much each counts. Waves act on the hull
before they arrive where their elevation is told, and the water slows large swings down more than
small ones. Trained at 6, 12 and 18 m/s, tested at 8, 10, 14
and 16 m/s, too.

    python examples/iea15/rotor_model.py [--output out/]
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import dfsm
from dfsm.cli.tables import print_validations
from dfsm.errors import hushed
from turbine_runs import (
    ALL_WINDS,
    AZIMUTH,
    BETWEEN,
    BETWEEN_PERTURBED,
    CONTROLS,
    DATA,
    DISTURBANCES,
    HUB_HEIGHT,
    OUTPUTS,
    START,
    between,
    perturbed,
    runs,
    with_rings,
)

RINGS = ("U_r015", "U_r036", "U_r057", "U_r078", "U_r099", "U_r116", "U_cubic")
# The elevation so many seconds ahead: waves of 7 s need four to go from one column to the next.
AHEAD = tuple(dfsm.Feature(source="Wave1Elev", kind="lead", seconds=s) for s in (2.0, 4.0, 6.0))
# The middle of the blades, three quarters out, is upwind of the hub by their cone of 4 deg: in m.
OVERHANG = 12.03 + 0.75 * 120.97 * math.sin(math.radians(4))
# The wind's rate, by which it meets the wind earlier; over two seconds, for nothing faster counts.
GUSTS = dfsm.Feature(source="RotWind", kind="rate", seconds=1.0)
# Of the hull and its plates in the water, with the square of the pitch rate.
DRAG = dfsm.QuadraticDrag(velocity="PtfmPitch_dot", name="drag")
# What moves the platform besides the rotor and drag, by the equation of motion in pitch.
HYDRODYNAMICS = (
    *("PtfmPitch", "PtfmPitch_dot", "Wave1Elev", "Wave1Elev_dot"),
    *("RotShearV", "RotShearH"),
)


def rotor(rings: Sequence[str] = RINGS) -> dfsm.Rotor:
    """The rotor of this turbine on its platform."""
    return dfsm.Rotor(
        table=DATA / "Cp_Ct_Cq.IEA15MW.txt",
        radius=120.97,
        wind="RotWind",
        speed="GenSpeed",
        pitch="BldPitch1",
        hub_height=HUB_HEIGHT,
        pitch_rate="PtfmPitch_dot",
        overhang=OVERHANG,
        wind_rate=GUSTS.name,
        platform_pitch="PtfmPitch",
        corrections=tuple(f"{ring}-RotWind" for ring in rings),
        inertia=318.6e6,  # with the generator
        generator_torque="GenTq",
        induction="lag",
        memory="wind",
        uncertainty=0.1,
    )


def settings(
    rings: Sequence[str] = RINGS,
    ahead: Sequence[dfsm.Feature] = AHEAD,
    drag: bool = True,
) -> dfsm.FitSettings:
    """Signals and structure. Wave forces need the elevation's rate, and what it will be.

    Only outputs are corrected: what controllers and optimizers do with a model, no run did.
    """
    dragging = (DRAG,) if drag else ()
    moving = (*HYDRODYNAMICS, *("drag" for _ in dragging), *(feature.name for feature in ahead))
    excess = (dfsm.Feature(source=r, kind="difference", less="RotWind") for r in rings)
    return dfsm.FitSettings(
        states=(
            dfsm.StateSpec(name="PtfmPitch", order=2),
            dfsm.StateSpec(name="GenSpeed"),
        ),
        controls=CONTROLS,
        disturbances=DISTURBANCES,
        features=(
            GUSTS,
            dfsm.Feature(source="Wave1Elev"),
            *ahead,
            *excess,
        ),
        outputs=OUTPUTS,
        terms=(rotor(rings), *dragging),
        linear=dfsm.LPV(
            schedule="RotWind",
            points=9,
            margin=0.01,
            only={"PtfmPitch": ("rotor.thrust", "rotor.torque", *moving)},
        ),
        corrective=dfsm.RBF(),
        corrected=OUTPUTS,
        azimuth=AZIMUTH,
        start=START,
        nonlinear_only=False,
    )


# What is remembered is wind and waves alone, not the controller's answer to them, so that the model
# holds for others.
REFINEMENT = dfsm.RefineSettings(
    windows=(20.0, None),
    step=0.5,
    iterations=25,
    latents=8,
    latent_inputs=(
        *("RotWind", "RotShearV", "RotShearH", "Wave1Elev", "Wave1Elev_dot"),
        *(f"{ring}-RotWind" for ring in RINGS),
        *(feature.name for feature in AHEAD),
    ),
    decay=6.0,
)


def fitted() -> dfsm.FitResult:
    """The model, trained on seeds 1 to 8 and five runs with perturbed controls."""
    training = [*runs(ALL_WINDS, range(1, 9)), *perturbed(testing=False)]
    return dfsm.fit(with_rings(training), settings(), REFINEMENT)


def main() -> None:
    """Fit, validate on unseen seeds, perturbed controls and winds, and print the table."""
    parser = argparse.ArgumentParser(description="A model that holds the rotor's table.")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the model")
    output: Path = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    with dfsm.show_progress(), hushed():
        model = fitted().model
        dfsm.save(model, output / "model_rotor")
        tests = {
            "seeds 9 and 10": runs(ALL_WINDS, range(9, 11)),
            "perturbed controls": perturbed(testing=True),
            "winds between": between(BETWEEN),
            "winds between, perturbed": between(BETWEEN_PERTURBED),
        }
        validations = {
            label: dfsm.validate(model, with_rings(tested), start=START)
            for label, tested in tests.items()
        }
    print_validations(validations)


if __name__ == "__main__":
    main()
