"""What a user sees when something is wrong: one sentence that says what came and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class DfsmError(Exception):
    """Bad input, told in one sentence: what came, what was expected, what to do.

    The command line prints the sentence and exits with 2; a Python caller catches one type.
    """


class DfsmWarning(UserWarning):
    """Something a user should know about a result that was produced nevertheless."""


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
    folded = {k.casefold(): k for k in known}
    close = difflib.get_close_matches(name.casefold(), list(folded), n=3, cutoff=0.6)
    if close:
        return "did you mean " + " or ".join(f"'{folded[c]}'" for c in close) + "?"
    shown = ", ".join(known[:12]) + (", …" if len(known) > 12 else "")
    return f"known are: {shown}" if known else "none are known"
