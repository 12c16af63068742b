"""What is known of the coefficients of the derivatives before any run is looked at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dfsm.data.derivatives import kinematic_rows
from dfsm.errors import DfsmError, near_matches
from dfsm.fitting.samples import Samples
from dfsm.fitting.settings import FitSettings
from dfsm.models.terms import Rotor, RotorTerm, TermSettings


@dataclass(frozen=True)
class KnownCoefficients:
    """Coefficients that least squares does not fit, by fitted row and column of [I, φ].

    Attributes
    ----------
    fixed
        Never changed.
    first
        Where refinement on rollouts begins.
    balances
        Fitted rows that are a balance of known torques, to which no offset is added.
    """

    fixed: Mapping[tuple[int, int], float]
    first: Mapping[tuple[int, int], float]
    balances: tuple[int, ...] = ()


def fitted_rows(samples: Samples, settings: FitSettings) -> list[int]:
    """Rows of ξ̇ that are fitted: all but those that are states themselves."""
    kinematic = kinematic_rows(settings.states)
    return [row for row in range(samples.derivatives.shape[1]) if row not in kinematic]


def known_coefficients(
    samples: Samples, settings: FitSettings, fitted: Sequence[int]
) -> KnownCoefficients:
    """What ``linear.known``, ``linear.only`` and rotors of known inertia say.

    Parameters
    ----------
    samples
        Tell the names of rows and columns.
    settings
        Of the fit.
    fitted
        Rows that are not kinematic.

    Raises
    ------
    DfsmError
        A name is no state or no input, or a rotor's speed is no state.
    """
    rates = kinematic_rows(settings.states)
    rows = {
        spec.name: list(fitted).index(rates.get(i, i)) for i, spec in enumerate(settings.states)
    }
    names = samples.linear_names
    mechanics = _mechanics(samples, settings)
    known = {**mechanics, **settings.linear.known}
    fixed, first = dict[tuple[int, int], float](), dict[tuple[int, int], float]()
    for name in (n for s in settings.terms if isinstance(s, Rotor) for n in s.winds):
        fixed.update({(row, names.index(name)): 0.0 for row in rows.values()})
    for state in mechanics:
        # In closed loop torque and blade pitch follow the speed, and least squares on derivatives
        # would take that for a property of the rotor.
        row = _row(rows, state, "known")
        fixed.update({(row, c): 0.0 for c in range(len(names))})
    for state, inputs in settings.linear.only.items():
        row = _row(rows, state, "only")
        columns = [_column(names, n, f"only.{state}") for n in inputs]
        first.update({(row, c): 0.0 for c in range(len(names)) if c not in columns})
    for state, coefficients in known.items():
        row = _row(rows, state, "known")
        for name, value in coefficients.items():
            place = row, _column(names, name, f"known.{state}")
            fixed[place] = float(value)
            first.pop(place, None)
    balances = tuple(
        rows[s.speed]
        for s in settings.terms
        if isinstance(s, Rotor) and s.memory == "wind" and s.speed in mechanics
    )
    return KnownCoefficients(fixed, first, balances)


def wakes_of(terms: Sequence[TermSettings]) -> dict[int, tuple[str, ...]]:
    """What states of the induced velocities of rotors are called, by place of the term."""
    return {
        place: (f"{rotor.name}.induced", f"{rotor.name}.induced_slow")
        for place, rotor in enumerate(terms)
        if isinstance(rotor, Rotor) and rotor.induction == "lag"
    }


def _row(rows: Mapping[str, int], state: str, key: str) -> int:
    if state not in rows:
        raise DfsmError(
            f"linear.{key} names '{state}', which is not a state; " + near_matches(state, rows)
        )
    return rows[state]


def _column(names: Sequence[str], name: str, key: str) -> int:
    if name not in names:
        raise DfsmError(
            f"linear.{key} names '{name}', which is no input of the model; "
            + near_matches(name, names)
        )
    return list(names).index(name)


# -- rotors of known inertia, J ω̇ = Q - τ ---------------------------------------------------------


def _mechanics(samples: Samples, settings: FitSettings) -> dict[str, dict[str, float]]:
    """What the torques of rotor and generator do to a rotor's speed, by state; all that does."""
    known = dict[str, dict[str, float]]()
    parts = () if samples.terms is None else samples.terms.parts
    for rotor, term in zip(settings.terms, parts, strict=True):
        if not (isinstance(rotor, Rotor) and isinstance(term, RotorTerm)):
            continue
        push, brake = term.acceleration_per_rotor_torque, term.acceleration_per_generator_torque
        if rotor.generator_torque is not None and push is not None and brake is not None:
            known[rotor.speed] = {rotor.generator_torque: brake, term.channels[1].name: push}
    return known
