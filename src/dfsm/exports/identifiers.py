"""Names and texts of a model as C can hold them."""

from __future__ import annotations

import re
from collections.abc import Iterable

# Words of C99 and C++ that are no names.
_TAKEN = frozenset(
    (
        *("auto", "break", "case", "char", "class", "const", "continue", "default", "delete", "do"),
        *(
            "double",
            "else",
            "enum",
            "extern",
            "float",
            "for",
            "goto",
            "if",
            "inline",
            "int",
            "long",
        ),
        *(
            "new",
            "operator",
            "private",
            "public",
            "register",
            "restrict",
            "return",
            "short",
            "this",
        ),
        *("signed", "sizeof", "static", "struct", "switch", "throw", "try", "typedef", "union"),
        *("unsigned", "void", "volatile", "while"),
    )
)


def identifier(name: str) -> str:
    """A name of C and of a function of CasADi: letters, digits and single underscores."""
    plain = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "model"
    plain = plain if plain[0].isalpha() else f"m_{plain}"
    return f"{plain}_model" if plain in _TAKEN else plain


def literal(text: str) -> str:
    """A string of C99: bytes beyond ASCII, and what the compiler would read as more, as octals."""
    kept = "".join(
        chr(b) if 32 <= b < 127 and chr(b) not in '"\\?' else f"\\{b:03o}" for b in text.encode()
    )
    return f'"{kept}"'


def comment(text: str) -> str:
    """A text in ASCII that ends no comment."""
    plain = text.encode("ascii", "backslashreplace").decode()
    plain = "".join(c if c.isprintable() else " " for c in plain)
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ?/").rstrip("\\")


def one_line(text: str) -> str:
    """A text without what XML cannot hold or its readers change: single spaces for the rest."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def strings(name: str, texts: Iterable[str]) -> str:
    """The definition of an array of strings that ends with a null pointer."""
    listed = "".join(f"  {literal(t)},\n" for t in texts)
    return f"const char *const {name}[] = {{\n{listed}  0\n}};\n"


def numbers(name: str, values: Iterable[float]) -> str:
    """The definition of an array of numbers; one zero where there are none."""
    listed = ", ".join(repr(float(v)) for v in values) or "0.0"
    return f"const double {name}[] = {{{listed}}};\n"
