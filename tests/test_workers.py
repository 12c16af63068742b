"""What is left of the workers of a process that is killed alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from test_compare import group_lives, wait_for

CODE = """
import time
from pathlib import Path
from dfsm.core.workers import work_through

def work(shared, task):
    Path(f"{task}.begun").touch()
    time.sleep(1000)

if __name__ == "__main__":
    list(work_through(work, None, (1, 2), 2))
"""


@pytest.mark.skipif(os.name == "nt", reason="no process groups there")
def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    Path(tmp_path / "run.py").write_text(CODE)
    command = [sys.executable, str(tmp_path / "run.py")]
    path = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    process = subprocess.Popen(
        command, start_new_session=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path}
    )
    wait_for(lambda: len(list(tmp_path.glob("*.begun"))) == 2)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    wait_for(lambda: not group_lives(process.pid))
