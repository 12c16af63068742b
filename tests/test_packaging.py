"""What stands beside the code and is read by other programs: contracts, citation, CI."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from dfsm.core.version import __version__

ROOT = Path(__file__).parents[1]
LINT = Path(sys.executable).with_name("lint-imports")


def from_yaml(path: str) -> dict:
    return YAML(typ="safe").load(ROOT / path)


# -- contracts ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package and its contracts where they may be spoilt."""
    folder = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "src", folder / "src", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def checked(copy: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [LINT, "--no-cache"],
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy / "src")},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("module", "line", "told"),
    [
        ("numerics/spectra.py", "import dfsm.control", "dfsm.numerics.spectra -> dfsm.control"),
        ("control/mesh/grid.py", "import casadi", "dfsm.control.mesh.grid -> casadi"),
    ],
)
def test_a_wrong_import_breaks_a_contract(copy, module, line, told):
    path = copy / "src" / "dfsm" / module
    text = path.read_text(encoding="utf-8")
    try:
        path.write_text(f"{text}\n{line}\n", encoding="utf-8")
        spoilt = checked(copy)
    finally:
        path.write_text(text, encoding="utf-8")
    assert spoilt.returncode == 1
    assert told in spoilt.stdout.replace("\n", " ")


# -- citation -----------------------------------------------------------------------------------


def test_the_citation_is_of_this_version():
    citation = from_yaml("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == __version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["license"] == project["license"]
    assert citation["authors"] == project["authors"]
    assert set(citation["keywords"]) <= set(project["keywords"])
    (paper,) = citation["references"]
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    assert paper["title"] in readme


# -- what runs the checks -----------------------------------------------------------------------


def test_everything_that_checks_calls_targets_of_the_makefile():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^(\w+):", makefile, re.MULTILINE))
    hooks = [h["entry"] for h in from_yaml(".pre-commit-config.yaml")["repos"][0]["hooks"]]
    jobs = from_yaml(".github/workflows/ci.yml")["jobs"]
    steps = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    called = [*hooks, *steps, *(line for line in script if line.startswith("make "))]
    assert all(re.fullmatch(r"make \w+", call) for call in called)
    assert {call.removeprefix("make ") for call in called} <= targets
    lint = re.search(r"^lint: (.*)$", makefile, re.MULTILINE)
    assert lint is not None
    assert [hook.removeprefix("make ") for hook in hooks] == lint[1].split()


def test_ci_covers_every_python_that_the_package_names():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [c.split(" :: ")[-1] for c in project["classifiers"] if ":: Python :: 3." in c]
    matrix = from_yaml(".github/workflows/ci.yml")["jobs"]["test"]["strategy"]["matrix"]
    assert matrix["python"] == named
    assert project["requires-python"] == f">={named[0]}"


def test_contributing_names_files_that_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = re.findall(r"`((?:src|tests|docs|benchmarks)/[\w./]+)`", text)
    assert len(paths) > 8
    assert [p for p in paths if not (ROOT / p).exists()] == []
    # What a table is called in the file that is named for it.
    entries = re.findall(r"`(\w+)` in `([\w/]+/[\w.]+)`", text)
    assert len(entries) > 5
    for name, path in entries:
        assert re.search(rf"^{name}\b", (ROOT / path).read_text(encoding="utf-8"), re.MULTILINE), (
            name
        )
    targets = re.findall(r"^    make (\w+)", text, re.MULTILINE)
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert [t for t in targets if f"\n{t}:" not in makefile] == []
