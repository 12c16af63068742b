"""What a user sees when something is wrong: one sentence that says what came and what to do."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

# Share of letters in common from which two names are alike.
_ALIKE = 0.6


class DfsmError(Exception):
    """Bad input, told in one sentence: what came, what was expected, what to do.

    The command line prints the sentence and exits with 2; a Python caller catches one type.
    """


class DfsmWarning(UserWarning):
    """Something a user should know about a result that was produced nevertheless."""


@contextmanager
def hushed() -> Iterator[None]:
    """Without dfsm's warnings: whoever calls tells what became of the data and the rollouts."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DfsmWarning)
        yield


def printable(text: str) -> str:
    """Show what a terminal would act on or break a line at as an escape: names are data."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def near_matches(name: str, known: Iterable[str]) -> str:
    """Suggest known names that resemble `name`, as the tail of an error sentence.

    Parameters
    ----------
    name
        What the user wrote.
    known
        The names that exist.

    Returns
    -------
    str
        ``"did you mean 'PtfmPitch'?"`` or, where nothing is close, the first known names.
    """
    known = list(known)
    return _question(_close(name, known)) or _listed(known)


def missing(names: Sequence[str], known: Iterable[str]) -> str:
    """Say which channels are not among the known ones, each with what it may stand for.

    Parameters
    ----------
    names
        What was looked for in vain, at least one.
    known
        The channels that exist.

    Returns
    -------
    str
        ``"no channel 'GenSped'; did you mean 'GenSpeed'?"``, or all of several names at once.
    """
    known = list(known)
    if len(names) == 1:
        return f"no channel '{names[0]}'; {near_matches(names[0], known)}"
    asked = {n: _question(_close(n, known)) for n in names}
    told = ", ".join(f"'{n}'" + (f" ({q})" if q else "") for n, q in asked.items())
    return f"no channels {told}" + ("" if all(asked.values()) else f"; {_listed(known)}")


def _close(name: str, known: Sequence[str]) -> list[str]:
    """Known names that resemble or contain `name`, or stand in it, best first; case is ignored."""
    wanted, found = name.casefold(), list[tuple[float, str]]()
    for candidate in known:
        folded = candidate.casefold()
        if folded == wanted:
            return [candidate]
        likeness = difflib.SequenceMatcher(None, folded, wanted).ratio()
        # One letter stands in almost any name.
        part = min(len(folded), len(wanted)) > 1 and (wanted in folded or folded in wanted)
        if part or likeness >= _ALIKE:
            found.append((likeness, candidate))
    return [candidate for _, candidate in sorted(found, key=lambda f: -f[0])[:3]]


def _question(close: Sequence[str]) -> str:
    return "did you mean " + " or ".join(f"'{c}'" for c in close) + "?" if close else ""


def _listed(known: Sequence[str]) -> str:
    shown = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
    return f"known are: {shown}" if known else "none are known"
