"""Records of known systems: right coefficients where nothing is told, a sentence where not."""

from __future__ import annotations

import pytest

from benchmarks import field
from benchmarks.readme import DOCS

# What a sentence says of each record that a fit cannot be right about.
SENTENCES = {
    "an input that acts 20 s late": "'u' acts about 19",
    "a controller against an unknown force": "feedback biases the effect",
    "a noisy input": "is white and has no effect",
    "twelve samples": "fewer independent samples than the fit has coefficients",
}


@pytest.fixture(scope="module")
def figures():
    return field.run()


@pytest.mark.parametrize("name", field.SYSTEMS)
def test_a_record_is_fitted_right_or_told(figures, name):
    result = figures[name]
    if name in SENTENCES:
        assert SENTENCES[name] in result["told"]
        return
    assert result["told"] == ""
    for key, value in result["true"].items():
        assert result["dfsm"][key] == pytest.approx(value, rel=0.02, abs=1e-6)


def test_the_page_shows_them(figures):
    page = (DOCS / "what-a-fit-says.md").read_text(encoding="utf-8")
    for line in field.field_table(figures):
        # The last cell is a sentence, whose figures may end otherwise elsewhere.
        assert line.rsplit(" | ", 1)[0] in page
