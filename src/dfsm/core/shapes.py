"""Array types with shapes, one name for each shape that signatures share.

Where a size occurs twice in a signature it is one size. Tests check them as the functions are
called (jaxtyping, beartype); for users they are words: jaxtyping, which takes 0.1 s to import, is
only asked where somebody has imported it before.
"""

import sys
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING or "jaxtyping" in sys.modules:
    from jaxtyping import Float, Int
else:

    class Float:
        """An array, whatever its shape."""

        def __class_getitem__(cls, item: tuple[type, str]) -> Any:
            return item[0]

    Int = Float

Series = Float[np.ndarray, "time"]
Samples = Float[np.ndarray, "sample input"]
Points = Float[np.ndarray, "point input"]
Targets = Float[np.ndarray, "sample target"]
Means = Float[np.ndarray, "point target"]
Bins = Float[np.ndarray, "bin"]
Labels = Int[np.ndarray, "sample"]
Rows = Int[np.ndarray, "row"]
