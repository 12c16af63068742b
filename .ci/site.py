"""Pages of the documentation site that are made from other files: scripts, and the API reference.

MkDocs calls the functions named ``on_…``; the others need nothing but the standard library.
"""

from __future__ import annotations

import ast
import posixpath
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SOURCES, REFERENCE = "sources", "reference"
_LINK = re.compile(r"(?<=\]\()([^)\s#]+)(#[^)\s]*)?(?=\))")
_FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)

# What a package of the reference is about, in a reader's words; others bear their own name.
_TITLES = {
    "data": "Data",
    "simulators": "Simulators",
    "models": "Models",
    "controllers": "Controllers",
    "fitting": "Fitting",
    "refinement": "Refinement",
    "simulation": "Simulation",
    "validation": "Validation",
    "selection": "Comparing structures",
    "control": "Optimal control",
    "loops": "Loops",
    "exports": "Exports",
    "report": "Reports",
    "config": "Configuration",
    "core": "Progress",
    "errors": "Errors",
}

# What begins the page of its package; others follow in the order of the table of names.
_FIRST = ("DFSM", "fit", "FitSettings", "FitResult", "ODESystem", "simulate", "validate", "solve")


def links(markdown: str) -> list[tuple[str, str]]:
    """Targets inside the repository, and their anchors, outside fenced code."""
    found = _LINK.findall(_FENCED.sub("", markdown))
    return [(t, a) for t, a in found if not re.match(r"[a-z]+:", t)]


def placed(origin: str, target: str) -> str:
    """Path of a target within the repository, for a link of the file `origin`."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))


def page_of(path: str) -> str:
    """Page of the site, relative to ``docs``, that shows a file of the repository."""
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    stem = path.removesuffix(".md")
    return f"{SOURCES}/{stem}.md"


def linked_sources(pages: Mapping[str, str]) -> dict[str, str]:
    """Files outside ``docs`` that pages link to: path in the repository to its text.

    Files that these link to in turn are among them.

    Parameters
    ----------
    pages
        Path in the repository to Markdown.
    """
    found: dict[str, str] = {}
    waiting = dict(pages)
    while waiting:
        origin, markdown = waiting.popitem()
        for target, _ in links(markdown):
            path = placed(origin, target)
            if path.startswith("docs/") or path in found or not (ROOT / path).is_file():
                continue
            found[path] = (ROOT / path).read_text(encoding="utf-8")
            if path.endswith(".md"):
                waiting[path] = found[path]
    return found


def as_page(path: str, text: str) -> str:
    """A file of the repository as Markdown: scripts as code, percent scripts cell by cell."""
    if path.endswith(".md"):
        return text
    if not re.search(r"^# %%", text, re.MULTILINE):
        return f"# {posixpath.basename(path)}\n\n`{path}`\n\n```python\n{text.rstrip()}\n```\n"
    parts = [f"*`{path}`: run it as a script, or open it as a notebook with Jupytext.*"]
    for cell in re.split(r"^# %%", text, flags=re.MULTILINE)[1:]:
        kind, _, body = cell.partition("\n")
        if "[markdown]" in kind:
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines()]
            parts.append("\n".join(lines))
        elif body.strip():
            parts.append(f"```python\n{body.strip()}\n```")
    # The title comes first.
    head = next((i for i, part in enumerate(parts) if part.startswith("# ")), None)
    if head is not None:
        title, _, rest = parts[head].partition("\n")
        parts[head : head + 1] = [rest.strip()]
        parts.insert(0, title)
    return "\n\n".join(part for part in parts if part) + "\n"


def relinked(markdown: str, origin: str, known: Iterable[str]) -> str:
    """Links between files of the repository as links between pages of the site."""
    here, shown = page_of(origin), set(known)

    def change(match: re.Match[str]) -> str:
        target, anchor = match[1], match[2] or ""
        path = placed(origin, target)
        if re.match(r"[a-z]+:", target) or path not in shown:
            return match[0]
        return posixpath.relpath(page_of(path), posixpath.dirname(here) or ".") + anchor

    return _LINK.sub(change, markdown)


def public_names(source: str) -> dict[str, str]:
    """Public names of the package and where they live, from the text of its ``__init__``."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "_HOME":
            return ast.literal_eval(node.value)
    raise ValueError("src/dfsm/__init__.py has no table _HOME")


def reference_pages(homes: Mapping[str, str]) -> dict[str, str]:
    """Pages of the API reference, one for each package, in the order of the data flow.

    Parameters
    ----------
    homes
        Public name to the module that it lives in.
    """
    packages: dict[str, list[str]] = {}
    for name, home in homes.items():
        packages.setdefault(home.partition(".")[0], []).append(name)
    order = [*_TITLES, *packages]
    pages = {}
    for package in sorted(packages, key=order.index):
        title = _TITLES.get(package, package.capitalize())
        ordered = sorted(packages[package], key=lambda name: name not in _FIRST)
        names = "\n\n".join(f"::: dfsm.{name}" for name in ordered)
        pages[f"{REFERENCE}/{package}.md"] = f"# {title}\n\n{names}\n"
    return pages


def listed(nav: Any) -> list[str]:
    """Pages that a navigation names, in its order."""
    if isinstance(nav, str):
        return [nav]
    return [n for part in (nav.values() if isinstance(nav, dict) else nav) for n in listed(part)]


def unlisted(nav: Any, pages: Iterable[str]) -> list[str]:
    """Pages that a navigation does not name."""
    named = set(listed(nav))
    return sorted(page for page in pages if page not in named)


def _reference() -> dict[str, str]:
    text = (ROOT / "src" / "dfsm" / "__init__.py").read_text(encoding="utf-8")
    return reference_pages(public_names(text))


def _documented() -> dict[str, str]:
    return {
        path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(DOCS.rglob("*.md"))
    }


# -- what MkDocs calls --------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    """Put pages that ``mkdocs.yml`` does not name, and the reference, behind those that it does."""
    if more := unlisted(config["nav"], [page_of(path) for path in _documented()]):
        config["nav"].append({"More": more})
    config["nav"].append({"API": list(_reference())})
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add what is made from other files."""
    from mkdocs.structure.files import File, InclusionLevel

    made = {name: (text, InclusionLevel.INCLUDED) for name, text in _reference().items()}
    for path, text in linked_sources(_documented()).items():
        made[page_of(path)] = (as_page(path, text), InclusionLevel.NOT_IN_NAV)
    for name, (text, inclusion) in made.items():
        files.append(File.generated(config, name, content=text, inclusion=inclusion))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let links lead to pages of the site."""
    pages = _documented()
    sources = linked_sources(pages)
    origins = {page_of(path): path for path in (*pages, *sources)}
    origin = origins.get(page.file.src_uri)
    return markdown if origin is None else relinked(markdown, origin, origins.values())
