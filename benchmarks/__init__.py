"""Measurements behind the figures in the documentation: ``python -m benchmarks``."""

import sys
from pathlib import Path

# The studies that some of them repeat.
_EXAMPLES = Path(__file__).parents[1] / "examples"
sys.path += [str(_EXAMPLES / name) for name in ("iea15", "robot")]
