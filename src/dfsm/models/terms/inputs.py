"""Where the channels that a term takes stand among the inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from dfsm.data.trajectory import Channel
from dfsm.errors import DfsmError, near_matches


def input_columns(
    what: str,
    names: Sequence[str],
    channels: Mapping[str, Channel],
    columns: Mapping[str, int],
) -> tuple[list[Channel], tuple[int, ...]]:
    """Channel and column of every input of a term.

    Parameters
    ----------
    what
        How messages call the term.
    names
        Channels that it takes.
    channels, columns
        Of all inputs, by name.

    Raises
    ------
    DfsmError
        One is no input of the model; names those that are near.
    """
    for name in names:
        if name not in columns or name not in channels:
            raise DfsmError(
                f"{what}: '{name}' is no state, control, disturbance or parameter of the model; "
                f"{near_matches(name, columns)}"
            )
    return [channels[name] for name in names], tuple(columns[name] for name in names)
