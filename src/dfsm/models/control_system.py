"""Matrices of a model as a system of python-control (`dfsm[control]`), with its channels' names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dfsm.core.types import Array
from dfsm.errors import DfsmError

if TYPE_CHECKING:
    import control


def control_system(
    matrices: Sequence[Array],
    states: Sequence[str],
    inputs: Sequence[str],
    outputs: Sequence[str],
) -> control.StateSpace:
    """Make a state-space system of A, B, C and D.

    Parameters
    ----------
    matrices
        A ``(state, state)``, B ``(state, input)``, C ``(output, state)``, D ``(output, input)``.
    states, inputs, outputs
        Names. python-control takes a dot for the end of a system's name: it becomes ``_``.

    Raises
    ------
    DfsmError
        python-control is not installed, or holds no such system.
    """
    try:
        import control
    except ImportError:
        raise DfsmError(
            "state-space systems need python-control: pip install 'dfsm[control]'"
        ) from None
    if matrices[1].shape == (1, 0):
        raise DfsmError(
            "the model has one state and neither controls nor disturbances, a system that "
            "python-control does not hold: take A, its only eigenvalue, from to_state_space or "
            "jacobians"
        )
    names = {"states": states, "inputs": inputs, "outputs": outputs}
    labels = {group: _without_dots(named) for group, named in names.items()}
    return control.StateSpace(*matrices, **labels)


def _without_dots(names: Sequence[str]) -> list[str]:
    """Names that stay different."""
    taken, found = set(names), list[str]()
    for name in names:
        plain = name.replace(".", "_")
        while plain != name and plain in taken:
            plain += "_"
        taken.add(plain)
        found.append(plain)
    return found
