"""The main job on bundled data: fit, simulate and validate the IEA 15 MW floating turbine.

Four models: one per region as in Sec. 4.2 of the paper (below rated, transition, rated: mean winds
of 6, 12 and 18 m/s), and one for all winds that goes beyond the paper, with the rotor's table
inside and latent states, refined on rollouts. Seeds 1 to 8 train (the last model also runs with
perturbed controls), 9 and 10 test.

    python examples/iea15/demo.py [--output out/]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import dfsm
import rotor_model
from dfsm.cli.tables import print_validations
from dfsm.core.files import write_json
from dfsm.core.progress import track
from dfsm.core.workers import processors, work_through
from dfsm.errors import hushed
from turbine_runs import (
    ALL_WINDS,
    AZIMUTH,
    CONTROLS,
    DISTURBANCES,
    OUTPUTS,
    START,
    runs,
    with_rings,
)

# Refined on rollouts, which takes most of the time.
REFINED = "all winds"
WINDS = {
    "6 m/s": ["06"],
    "12 m/s": ["12"],
    "18 m/s": ["18"],
    REFINED: ALL_WINDS,
}
# 1/s. Least squares leaves the platform mode undamped below rated wind, see docs/method.md. Chosen
# on rollouts of training seeds 3 and 7; the test seeds had no say.
MARGIN = 0.04
Result = tuple[dfsm.FitResult, dfsm.Validation]


def folder(output: Path, label: str) -> Path:
    """Where a model is kept."""
    name = label.replace(",", "").replace(" m/s", "mps").replace(" ", "_")
    return output / f"model_{name}"


def settings(points: int) -> dfsm.FitSettings:
    """The paper's states, controls and outputs; wind as disk average and slopes, and the waves."""
    return dfsm.FitSettings(
        states=(
            dfsm.StateSpec(name="PtfmPitch", order=2),
            dfsm.StateSpec(name="GenSpeed", order=2),
        ),
        controls=CONTROLS,
        disturbances=DISTURBANCES,
        outputs=OUTPUTS,
        linear=dfsm.LPV(schedule="RotWind", points=points, margin=MARGIN),
        corrective=dfsm.RBF(),  # as in the paper, and many times faster to train than a perceptron
        azimuth=AZIMUTH,
        start=START,
    )


def fit_and_validate(_: None, label: str) -> Result:
    """One of the models, and how it does on its test runs."""
    winds = WINDS[label]
    tests = runs(winds, range(9, 11))
    with hushed():  # what they say stands in the report
        if label == REFINED:
            fitted, tests = rotor_model.fitted(), with_rings(tests)
        else:
            fitted = dfsm.fit(runs(winds, range(1, 9)), settings(5))
        variants = dfsm.compared(fitted.model, fitted.nonlinear)
        return fitted, dfsm.validate(variants, tests, start=START)


def study(
    labels: Sequence[str] = tuple(WINDS),
    jobs: int | None = None,
    first: Callable[[Mapping[str, Result]], object] = lambda _: None,
) -> dict[str, Result]:
    """Fit the models, or some of them, and validate each on its test runs.

    Those that are not refined come first, so many at a time; `first` is called with them.
    """
    quick, fits = [label for label in labels if label != REFINED], dict[str, Result]()
    # Refinement takes all processors by itself.
    rest = [label for label in labels if label == REFINED]
    for some, at_once in ((quick, jobs or processors()), (rest, 1)):
        work = work_through(fit_and_validate, None, some, at_once)
        fits |= track(work, "models", len(some))
        if some and some is quick:
            first(dict(fits))
    return {label: fits[label] for label in labels}


def main() -> None:
    """Fit and validate all models, print the table, write the report."""
    parser = argparse.ArgumentParser(description="Fit and validate on bundled OpenFAST runs.")
    parser.add_argument("--output", type=Path, default=Path("out"), help="folder for the results")
    output = parser.parse_args().output
    output.mkdir(parents=True, exist_ok=True)
    begin, report = time.perf_counter(), output / "report.html"

    def publish(results: Mapping[str, Result]) -> dict[str, dfsm.Validation]:
        validations = {label: validation for label, (_, validation) in results.items()}
        dfsm.write_report(validations, report, title="IEA 15 MW floating turbine")
        return validations

    def first(results: Mapping[str, Result]) -> None:
        publish(results)
        print(
            f"{time.perf_counter() - begin:.0f} s: {', '.join(results)} in {report.resolve()}; "
            "the refined model follows",
            flush=True,
        )

    with dfsm.show_progress():
        results = study(first=first)
        for label, (fitted, _) in results.items():
            dfsm.save(fitted.model, folder(output, label), fitted.nonlinear)
        validations = publish(results)
    write_json(output / "metrics.json", {k: v.to_dict() for k, v in validations.items()})
    print_validations(validations)
    print(f"\n{time.perf_counter() - begin:.0f} s in all; report: {report.resolve()}")


if __name__ == "__main__":
    main()
