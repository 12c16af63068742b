"""Everything that a study leaves in a folder: a page, its tables as JSON, and figures for print."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from dfsm.core.files import check_file, write_json
from dfsm.report.article import Article
from dfsm.report.article_page import write_article
from dfsm.report.print_figures import write_figures


def page_of(folder: str | Path, key: str) -> Path:
    """Where `publish` writes the page; makes the folder, and fails early where it would fail.

    Raises
    ------
    DfsmError
        The page cannot be written there.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / f"{key}.html"
    for path in (page, page.with_suffix(".json")):
        check_file(path)
    return page


def publish(article: Article, folder: str | Path) -> list[Path]:
    """Write an article as a page, its tables as JSON, and its figures where Matplotlib is there.

    Parameters
    ----------
    article
        What to tell.
    folder
        It is made if need be; files of the same names are replaced.

    Returns
    -------
    list of Path
        What was written: the page, the JSON file, and the figures in a folder ``figures``.

    Raises
    ------
    DfsmError
        A file cannot be written.
    """
    page = page_of(folder, article.key)
    write_article(article, page)
    write_json(page.with_suffix(".json"), article.to_dict())
    drawn = write_figures(article, page.parent / "figures") if find_spec("matplotlib") else []
    return [page, page.with_suffix(".json"), *drawn]
