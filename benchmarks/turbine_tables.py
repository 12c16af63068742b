"""Tables of the floating turbine: rollouts, what limits them, and runs under the same wind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def rollouts_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of every step from the paper's recipe on."""
    lines = [
        "| model | pitch | pitch rate | rotor speed | perturbed: pitch, speed | diverged | fit |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, errors in figures["models"].items():
        closed, other = errors["closed loop"], errors["perturbed"]
        states = ("PtfmPitch", "PtfmPitch_dot", "GenSpeed")
        cells = [f"{_two(closed['filtered'][c])} ({_two(closed['unfiltered'][c])})" for c in states]
        cells.append(", ".join(_two(other["filtered"][c]) for c in (states[0], states[2])))
        cells.append(f"{closed['diverged'] + other['diverged']} of {closed['of'] + other['of']}")
        cells.append(f"{errors['fit_s']:.0f} s")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def loads_table(figures: Mapping[str, Any]) -> list[str]:
    """Tower-base loads of the last model, run by run."""
    lines = [
        "| run, load | NRMSE (below 0.5 Hz) | damage-equivalent load | power 0–0.3 Hz | power 3P "
        "| peaks off by bins: platform, wave |",
        "|---|---|---|---|---|---|",
    ]
    for run, loads in figures["loads"].items():
        for load, errors in loads.items():
            power, bins = errors["power_ratio"], errors["peak_bins"]
            cells = [
                f"{errors['nrmse']:.2f} ({errors['nrmse_filtered']:.2f})",
                f"{errors['del_ratio']:.2f}",
                f"{power['0-0.3 Hz']:.2f}",
                f"{power['3P']:.2f}",
                ", ".join("–" if b is None else f"{b:.0f}" for b in bins.values()),
            ]
            lines.append(f"| {run.removeprefix('iea15_2dof_')}, {load} | {' | '.join(cells)} |")
    return lines


def leak_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of a linear fit with each of three winds as its disturbance."""
    lines = ["| wind given to the model | pitch | pitch rate | rotor speed |", "|---|---|---|---|"]
    for wind, errors in figures["leak"].items():
        lines.append(f"| {wind} | {' | '.join(_two(v) for v in errors.values())} |")
    return lines


def limits_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors with fewer runs, other sizes of the network, and the thrust as an input."""
    lines = [
        "| model | training runs | training, validation | pitch | pitch rate | rotor speed "
        "| perturbed: pitch, speed |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, result in figures["variants"].items():
        closed, other = result["closed loop"]["filtered"], result["perturbed"]["filtered"]
        pair = ", ".join(f"{result[k] ** 0.5:.3f}" for k in ("training", "validation"))
        cells = [str(result["runs"]), pair, *(_two(v) for v in closed.values())]
        cells.append(_pitch_and_speed(other))
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def field_table(figures: Mapping[str, Any]) -> list[str]:
    """What explains the slow part of what the model's derivatives leave over."""
    lines = [
        "| left over, below 0.05 Hz | RotWind and its slopes | and the rest of the field "
        "| and the rest, shifted in time |",
        "|---|---|---|---|",
    ]
    for name, shares in figures["field"].items():
        three, whole = (f"{100 * shares[k]:.0f} %" for k in ("three signals", "whole field"))
        middle, most = (f"{100 * v:.0f} %" for v in shares["shifted"])
        lines.append(f"| {name} | {three} | {whole} | {middle} (95th percentile: {most}) |")
    return lines


def braking_table(figures: Mapping[str, Any]) -> list[str]:
    """Effect of torque on the speed's derivative, true and as derivatives teach it."""
    lines = ["| torque's effect (10⁻⁵ rpm/s per kN m) | weakest | strongest |", "|---|---|---|"]
    for name, pair in figures["braking"].items():
        cells = [f"{1e5 * v:.1f}".replace("-", "\N{MINUS SIGN}") for v in pair]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def matched_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors of rollouts, and of differences between rollouts under the same wind."""
    lines = [
        "| correlation of errors | pitch | pitch rate | rotor speed | perturbed: pitch, speed "
        f"| difference of the speed: {', '.join(figures['pairs'])} |",
        "|---|---|---|---|---|---|",
    ]
    for name, result in figures["models"].items():
        closed, other = result["closed loop"]["filtered"], result["perturbed"]["filtered"]
        cells = [name, *(_two(v) for v in closed.values())]
        cells.append(_pitch_and_speed(other))
        cells.append(", ".join(_two(errors[-1]) for errors in result["differences"]))
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def slopes_table(figures: Mapping[str, Any]) -> list[str]:
    """What the speed's derivative depends on, by differences of records."""
    lines = [
        "| pair of runs | speed (1/s) | pitch rate (rpm/s per deg/s) | blade pitch (rpm/s per deg) "
        "| torque (10⁻⁵ rpm/s per kN m) |",
        "|---|---|---|---|---|",
    ]
    for name, slopes in zip(figures["pairs"], figures["slopes"], strict=True):
        values = [f"{slopes[c]:.3f}" for c in ("GenSpeed", "PtfmPitch_dot", "BldPitch1")]
        cells = [*values, f"{1e5 * slopes['GenTq']:.1f}"]
        signed = [c.replace("-", "\N{MINUS SIGN}") for c in cells]
        lines.append(f"| {name} | {' | '.join(signed)} |")
    return lines


def below_rated_table(figures: Mapping[str, Any]) -> list[str]:
    """Errors below rated wind, of a model that is told what moves the rotor and one that is not."""
    lines = [
        "| at 6 m/s | controlled: pitch, speed | perturbed: pitch, speed "
        "| difference of the pair: pitch, speed |",
        "|---|---|---|---|",
    ]
    for name, errors in figures["below rated"].items():
        cells = [_pitch_and_speed(errors[k]["filtered"]) for k in ("closed loop", "perturbed")]
        difference = errors["differences"][0]
        cells.append(f"{_two(difference[0])}, {_two(difference[-1])}")
        lines.append(f"| model for {name} | {' | '.join(cells)} |")
    return lines


def sweep_table(figures: Mapping[str, Any]) -> list[str]:
    """The sweep of constant winds in one line per figure."""
    winds = figures["sweep"]
    reach = max(winds.values(), key=lambda f: f["half_ranges"])["half_ranges"]
    drift = max(f["drift"] for f in winds.values())
    done = sum(f["completed"] for f in winds.values())
    return [
        "| constant winds | simulated to the end | farthest from the middle | drift at last |",
        "|---|---|---|---|",
        f"| {' to '.join((next(iter(winds)), list(winds)[-1]))} m/s | {done} of {len(winds)} | "
        f"{reach:.2f} half-ranges | {drift:.0e} standard deviations per s |",
    ]


def _two(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _pitch_and_speed(errors: Mapping[str, float | None]) -> str:
    return ", ".join(_two(errors[c]) for c in ("PtfmPitch", "GenSpeed"))
