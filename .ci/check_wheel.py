"""Look into a wheel, then install it in a fresh environment and use it from an empty folder.

python .ci/check_wheel.py dist/dfsm-*.whl
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "dfsm"
# 400 kB of them are the plotting library of the pages.
MOST_BYTES = 1_500_000


def complaints(wheel: Path) -> list[str]:
    """What is wrong with the files in a wheel: too much, or something missing."""
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    packed = {n for n in names if not n.split("/")[0].endswith(".dist-info")}
    ours = {
        p.relative_to(PACKAGE.parent).as_posix()
        for p in PACKAGE.rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    told = [f"{name} is in the wheel and no part of the package" for name in packed - ours]
    told += [f"{name} is missing from the wheel" for name in ours - packed]
    if not any(n.endswith(".dist-info/licenses/LICENSE") for n in names):
        told.append("the licence is missing from the wheel")
    if wheel.stat().st_size > MOST_BYTES:
        told.append(f"the wheel has {wheel.stat().st_size} bytes, expected {MOST_BYTES} at most")
    return sorted(told)


def use(wheel: Path) -> None:
    """Install a wheel where nothing else is and call what users call first."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder) / "env", with_pip=True)
        scripts = Path(folder) / "env" / ("Scripts" if sys.platform == "win32" else "bin")
        pip = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")
        for command in (
            [scripts / "python", *pip, wheel.resolve()],
            [scripts / "dfsm", "--help"],
            [scripts / "python", "-c", "import dfsm; dfsm.fit"],
        ):
            subprocess.run([str(part) for part in command], cwd=folder, check=True)


def main() -> None:
    """Check the wheel that is named."""
    wheel = Path(sys.argv[1])
    told = complaints(wheel)
    if told:
        sys.exit("\n".join(told))
    use(wheel)
    print(f"{wheel.name}: {wheel.stat().st_size} bytes, installs and runs")


if __name__ == "__main__":
    main()
