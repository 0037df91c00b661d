"""Mathematics of a page: text with LaTeX between dollar signs -> HTML with MathML, offline.

Browsers draw MathML themselves, and screen readers speak it. The text may be a student's: all of it
is escaped, and of the MathML only known elements and attributes pass.
"""

import re
from functools import lru_cache
from typing import Any
from xml.etree import ElementTree

MAX_FORMULA, MAX_FORMULAS, MAX_DEPTH = 600, 60, 40  # characters, formulas of a text, braces
_FORMULA = re.compile(
    r"\$\$(.+?)\$\$|(?<![\\\w$])\$(?!\s)([^$\n]+?)(?<!\s)\$(?![\d\w$])", re.DOTALL
)
_TAGS = frozenset(
    (
        *("math", "mrow", "mi", "mn", "mo", "mtext", "mspace", "ms", "mfrac", "msqrt", "mroot"),
        *("mstyle", "merror", "mpadded", "mphantom", "mfenced", "menclose", "msub", "msup"),
        *("msubsup", "munder", "mover", "munderover", "mmultiscripts", "mtable", "mtr", "mtd"),
    )
)
_ATTRIBUTES = frozenset(
    (
        *("display", "mathvariant", "stretchy", "fence", "separator", "form", "movablelimits"),
        *("accent", "accentunder", "linethickness", "displaystyle", "scriptlevel", "columnalign"),
        *("rowspacing", "columnspacing", "width", "lspace", "rspace", "minsize", "maxsize"),
        *("symmetric", "largeop"),
    )
)


def mathematics(text: str) -> Any:
    """A text as HTML: escaped, with its formulas as MathML.

    What cannot be drawn (not LaTeX, too long, or latex2mathml of the extra `labs` is missing) is
    shown as it was typed.

    Args:
        text: with formulas as `$...$` and `$$...$$`.

    Returns:
        HTML, marked as such for a template.
    """
    from markupsafe import Markup, escape

    parts, end = [], 0
    for number, found in enumerate(_FORMULA.finditer(text)):
        drawn = _mathml(found[1] or found[2], bool(found[1])) if number < MAX_FORMULAS else ""
        parts.append(escape(text[end : found.start()]))
        parts.append(Markup(drawn) if drawn else escape(found[0]))
        end = found.end()
    return Markup("").join([*parts, escape(text[end:])])


@lru_cache(maxsize=512)  # a class's pages hold the same questions
def _mathml(latex: str, block: bool) -> str:
    """MathML of a formula; empty if it cannot be drawn."""
    if len(latex) > MAX_FORMULA or latex.count("{") + latex.count("\\left") > MAX_DEPTH:
        return ""
    try:
        from latex2mathml.converter import convert

        plain = latex.replace("\\operatorname", "\\mathrm")  # which the library sets in italics
        root = ElementTree.fromstring(convert(plain, display="block" if block else "inline"))
    except Exception:  # whatever a student typed, and whatever the library makes of it
        return ""
    for element in root.iter():
        tag = str(element.tag).rpartition("}")[2]
        if tag not in _TAGS:
            return ""
        element.tag = tag
        for name in [name for name in element.attrib if name not in _ATTRIBUTES]:
            del element.attrib[name]
    return ElementTree.tostring(root, encoding="unicode")
