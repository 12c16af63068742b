"""Print the flags with which XLA compiles quickly, of those that the installed one knows.

A flag that it does not know ends a process before it can say why, and versions differ.
"""

from __future__ import annotations

import os
import subprocess
import sys

FLAGS = ("--xla_backend_optimization_level=0", "--xla_cpu_use_fusion_emitters=false")
# Makes XLA read its flags.
READ = "import dfsm.core.jax_setup"


def known(flag: str) -> bool:
    """Whether a process with this flag lives."""
    command = [sys.executable, "-c", READ]
    ended = subprocess.run(
        command, env={**os.environ, "XLA_FLAGS": flag}, capture_output=True, check=False
    )
    return ended.returncode == 0


if __name__ == "__main__":
    print(*filter(known, FLAGS))
