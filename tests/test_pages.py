"""Pages of the documentation: what they link to exists, and what they show runs as it stands."""

from __future__ import annotations

import importlib.util
import re
import shlex
import unicodedata
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer
from ruamel.yaml import YAML

import dfsm as package
from conftest import CONFIG, write_config
from dfsm.cli import app
from dfsm.config.control import ControlConfig
from dfsm.config.fit import Config, parse_candidates
from dfsm.config.parse import parse_file

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {p.relative_to(ROOT).as_posix(): p.read_text(encoding="utf-8") for p in DOCS.rglob("*.md")}
READ = PAGES | {n: (ROOT / n).read_text(encoding="utf-8") for n in ("README.md", "CONTRIBUTING.md")}
YAML_BLOCKS = re.compile(r"^( *)```yaml\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
PYTHON_BLOCKS = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
# Pages that another test names have their code run there.
OTHERS = "".join(p.read_text(encoding="utf-8") for p in Path(__file__).parent.glob("test_*.py"))
RUN = [n for n, text in PAGES.items() if "```python" in text and f'{Path(n).name}"' not in OTHERS]


def site() -> ModuleType:
    """The module that makes pages of other files."""
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / ".ci" / "site.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SITE = site()


def anchors(markdown: str) -> set[str]:
    """Anchors of the headings, as MkDocs (and GitHub, for these headings) makes them."""
    text = re.sub(r"^```.*?^```", "", markdown, flags=re.DOTALL | re.MULTILINE)
    found = set()
    for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE):
        plain = unicodedata.normalize("NFKD", heading).encode("ascii", "ignore").decode()
        plain = re.sub(r"[^\w\s-]", "", plain).strip().lower()
        found.add(re.sub(r"[-\s]+", "-", plain))
    return found


def mapping(text: str) -> Any:
    return YAML(typ="safe").load(text)


# -- links --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", READ)
def test_links_lead_to_what_exists(name):
    lost = []
    for target, anchor in SITE.links(READ[name]):
        path = SITE.placed(name, target)
        made = path.removeprefix("docs/") in SITE.reference_pages(SITE.public_names(INIT))
        if not (made or (ROOT / path).exists()):
            lost.append(target)
        elif anchor and anchor[1:] not in anchors((ROOT / path).read_text(encoding="utf-8")):
            lost.append(target + anchor)
    for anchor in re.findall(r"\]\(#([^)]+)\)", READ[name]):
        if anchor not in anchors(READ[name]):
            lost.append(f"#{anchor}")
    assert lost == []


def test_the_navigation_names_pages_that_exist_once_each():
    nav = mapping((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    named = [f"docs/{name}" for name in SITE.listed(nav)]
    assert len(named) == len(set(named))
    assert set(named) <= set(PAGES)
    assert SITE.unlisted(nav, ["start.md", "new.md"]) == ["new.md"]


def test_pages_that_the_code_names_exist():
    code = [
        p for folder in ("src", "benchmarks", "examples") for p in (ROOT / folder).rglob("*.py")
    ]
    named = {
        n for p in code for n in re.findall(r"docs/[\w/-]+\.md", p.read_text(encoding="utf-8"))
    }
    assert "docs/hidden-states.md" in named
    assert {n for n in named if n not in PAGES} == set()


# -- pages made of other files ------------------------------------------------------------------

INIT = (ROOT / "src" / "dfsm" / "__init__.py").read_text(encoding="utf-8")


def test_the_reference_has_every_public_name():
    pages = SITE.reference_pages(SITE.public_names(INIT))
    shown = re.findall(r"^::: dfsm\.(\w+)$", "\n".join(pages.values()), re.MULTILINE)
    assert sorted(shown) == sorted(n for n in package.__all__ if n != "__version__")


def test_links_of_a_page_become_links_of_the_site():
    text = "[a](../method.md#x) [b](../../examples/two_link_robot.py) [c](https://example.org/a.md)"
    known = ["docs/method.md", "examples/two_link_robot.py"]
    assert SITE.relinked(text, "docs/how-to/index.md", known) == (
        "[a](../method.md#x) [b](../sources/examples/two_link_robot.py.md) "
        "[c](https://example.org/a.md)"
    )


def test_a_notebook_is_shown_cell_by_cell():
    script = "# ---\n# jupyter:\n# ---\n\n# %% [markdown]\n# # Title\n# Words.\n\n# %%\nx = 1\n"
    page = SITE.as_page("notebooks/n.py", script)
    assert page.startswith("# Title\n")
    assert "\nWords.\n" in page
    assert page.endswith("```python\nx = 1\n```\n")
    assert "jupyter:" not in page


# -- what pages show ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n, text in READ.items() if "```yaml" in text])
def test_yaml_is_taken(name, tmp_path):
    for number, (indent, block) in enumerate(YAML_BLOCKS.findall(READ[name])):
        lines = [line.removeprefix(indent) for line in block.splitlines()]
        keys, path = mapping("\n".join(lines)), tmp_path / f"{number}.yaml"
        if "horizon" in keys:
            write_config(path, keys)
            parse_file(path, ControlConfig, "")
            continue
        if not set(keys) & set(Config.model_fields):
            continue  # another kind of file
        config = {key: value for key, value in CONFIG.items() if key not in keys} | keys
        if "data" in keys:
            config["data"] = CONFIG["data"] | keys["data"]
        if "signals" in keys:
            config["signals"] = CONFIG["signals"] | keys["signals"]
        write_config(path, config)
        parse_file(path, Config, "")
        if "compare" in keys:
            parse_candidates(path)


def commands(markdown: str) -> list[list[str]]:
    """Calls of the command line in indented blocks, continued lines joined, comments left out."""
    text = markdown.replace("\\\n", " ")
    lines = re.findall(r"^ {4,}(dfsm .*)$", text, re.MULTILINE)
    return [shlex.split(line, comments=True)[1:] for line in lines]


@pytest.mark.parametrize("name", [n for n, text in READ.items() if commands(text)])
def test_commands_have_these_options(name):
    for words in commands(READ[name]):
        command: Any = typer.main.get_command(app)
        while hasattr(command, "commands"):
            called = command.commands.get(words.pop(0))
            assert called is not None, words
            command = called
        known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)}
        assert {w.partition("=")[0] for w in words if w.startswith("-")} <= known, words


@pytest.mark.filterwarnings("ignore::dfsm.errors.DfsmWarning")
@pytest.mark.parametrize("name", RUN)
def test_code_runs(name, here, fitted):
    (here / "model").symlink_to(fitted)
    code = "\n".join(PYTHON_BLOCKS.findall(PAGES[name]))
    exec(compile(code, name, "exec"), {})


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], dict[str, Any]]:
    """Folder with the runs of docs/start.md; its Python blocks, and the settings it names."""
    monkeypatch.chdir(tmp_path)
    page = PAGES["docs/start.md"]
    blocks = PYTHON_BLOCKS.findall(page)
    exec(compile(blocks[0], "docs/start.md", "exec"), {})
    return blocks, mapping(YAML_BLOCKS.findall(page)[0][1])


def test_the_five_minutes_begin_as_told(start, dfsm):
    info, init = commands(PAGES["docs/start.md"])[:2]
    for words in (info, init):
        words[-1:] = sorted(str(p) for p in Path().glob(words[-1]))
        assert dfsm(*words).code == 0
    proposed = mapping(Path("config.yaml").read_text(encoding="utf-8"))
    assert proposed["signals"]["states"] == [{"name": "Angle", "order": 2, "rate": "Rate"}]
    assert proposed["signals"]["controls"] == ["Torque"]


@pytest.mark.notebook
def test_the_five_minutes_end_as_told(start, dfsm):
    blocks, quick = start
    for words in commands(PAGES["docs/start.md"]):
        expanded = [str(p) for w in words for p in (sorted(Path().glob(w)) if "/*" in w else [w])]
        result = dfsm(*expanded)
        assert result.code == 0, result
        if words[0] == "init":
            path = Path("config.yaml")
            write_config(path, mapping(path.read_text(encoding="utf-8")) | quick)
        if words[0] == "fit":
            assert "Angle: usable" in result.out
    assert Path("report.html").exists()
    exec(compile(blocks[1], "docs/start.md", "exec"), {})
