"""The frame of every page: one HTML file that needs no network and runs only its own code."""

from __future__ import annotations

import base64
import hashlib
import json
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from dfsm.core.files import write_file
from dfsm.report.elements import Markup

# Plotly's own bundle of lines, bars and pies, a quarter of the whole with its maps and 3-D.
_PLOTLY = "plotly-basic.min.js"
# Reads arrays; it stands before the first script of each page.
_READER = "blobs.js"
_ESCAPES = {ord(c): f"\\u{ord(c):04x}" for c in "<>&\u2028\u2029"}


def document(
    title: str, body: Markup, data: Any, *, scripts: tuple[str, ...], css: tuple[str, ...] = ()
) -> str:
    """Return a page with Plotly, its data and the script that draws them.

    Parameters
    ----------
    title
        Shown by the browser.
    body
        Content.
    data
        JSON values, which the scripts read from the element ``data``.
    scripts
        Files of this package, in the order in which they run.
    css
        Files of this package besides ``page.css``.
    """
    own = files("dfsm.report")
    plotly, reader, first, *others = (
        (own / name).read_text(encoding="utf-8") for name in (_PLOTLY, _READER, *scripts)
    )
    code = [plotly, f"{reader}\n{first}", *others]
    style = "".join((own / name).read_text(encoding="utf-8") for name in ("page.css", *css))
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en">',
            "<head>",
            '<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_policy(code)}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            '<meta name="color-scheme" content="light dark">',
            f"<title>{escape(title)}</title>",
            f"<style>{style}</style>",
            "</head>",
            f"<body>{body}",
            f'<script type="application/json" id="data">{embed(data)}</script>',
            *[f"<script>{s}</script>" for s in code],
            "</body>",
            "</html>",
            "",
        ]
    )


def write_document(text: str, path: str | Path) -> None:
    """Write a page; an existing one is replaced when the new one is complete.

    Raises
    ------
    DfsmError
        The file cannot be written.
    """
    with write_file(path) as temporary:
        # File names may hold bytes that are no text.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def embed(data: Any) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return text.translate(_ESCAPES)


def _policy(scripts: list[str]) -> str:
    """Let nothing run but these scripts, and nothing be fetched.

    Escaping already keeps data from becoming code; should it ever fail, the browser refuses.
    """
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    allowed = " ".join(f"'sha256-{h}'" for h in hashes)
    return (
        f"default-src 'none'; script-src {allowed}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
