"""Formulas on pages: LaTeX becomes MathML, and nothing of a text gets through as markup."""

import time
from xml.etree import ElementTree

import pytest

from falconwing_kit.tools.reports.mathematics import mathematics


def test_a_formula_is_drawn_and_the_text_around_it_is_escaped():
    """MathML by its standard: a fraction has two children, an exponent is an msup."""
    found = str(mathematics(r"If $\frac{V^2}{g}$ < 5 & more"))
    before, formula, after = found.partition("<math")[0], found, found.partition("</math>")[2]
    assert before == "If " and after == " &lt; 5 &amp; more"
    root = ElementTree.fromstring(formula[3 : formula.index("</math>") + 7])
    (fraction,) = root.iter("mfrac")
    assert len(fraction) == 2 and [e.text for e in fraction.find(".//msup")] == ["V", "2"]
    assert 'display="block"' in str(mathematics("$$x$$"))


@pytest.mark.parametrize(
    "text",
    [
        "costs $5 and $6 more",
        "$<img src=x onerror=alert(1)>$",
        r"$\text{<script>alert(1)</script>}$",
        "<b>$ x $</b>",
        "$" + "{" * 5000 + "$",
        "$" + r"\frac" * 110 + "$",
        r"$\begin{pmatrix} a$",
    ],
)
def test_what_is_no_formula_stays_text(text):
    """Whatever it is, no element but MathML's comes out."""
    begin = time.monotonic()
    root = ElementTree.fromstring(f"<p>{mathematics(text)}</p>")
    assert {element.tag for element in root.iter()} <= {"p", "math", "mrow", "mi", "mn", "mo"}
    assert time.monotonic() - begin < 5.0


def test_links_and_styles_of_a_formula_are_dropped():
    """A link in a formula would be one that a student chose."""
    found = str(mathematics(r"$\href{javascript:alert(1)}{x} \class{a}{b} \color{red}{y}$"))
    assert "<math" in found and not any(w in found for w in ("href", "script", "class", "color"))
