"""Sphinx's settings for the site: staged sources -> HTML that loads nothing from the network.

`python manual/build.py site` stages the pages and calls Sphinx with this file.
"""

import re
from textwrap import dedent
from typing import Any

project = "FalconWing kit"
author = "The FalconWing kit contributors"
copyright = "the FalconWing kit contributors; text CC BY 4.0, code MIT"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

nb_execution_mode = "off"  # the build runs no notebook
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
myst_all_links_external = False

autodoc_member_order = "alphabetical"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
napoleon_numpy_docstring = False
default_role = "code"
maximum_signature_line_length = 80

html_theme = "furo"
html_title = "FalconWing kit"
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_copy_source = False
html_show_sourcelink = False
html_math_renderer = "mathml"
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5394", "color-brand-content": "#0b5394"},
    "dark_css_variables": {"color-brand-primary": "#8ab8f0", "color-brand-content": "#8ab8f0"},
}
pygments_style = "a11y-high-contrast-light"
pygments_dark_style = "a11y-high-contrast-dark"

_HEAD = re.compile(r"^(Args|Returns|Raises|Attributes|Yields|Example|Examples|Note):$")
_EQUATION = re.compile(r"\S.* = .*|.*\S {2,}\[.*\]$")
_COLON = "\ue000"  # stands for a colon that napoleon would take for the end of a type
_LONGEST = 40  # characters of a default that a signature shows


def setup(app: Any) -> None:
    """Called by Sphinx: docstrings as the kit writes them, and formulas as MathML."""
    app.connect("autodoc-process-docstring", plain_docstring, priority=400)  # before napoleon's 500
    app.connect("autodoc-process-docstring", colons_again, priority=600)
    app.connect("autodoc-process-signature", short_types)
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("object-description-transform", short_property)
    app.connect("html-page-context", line_ends)
    app.add_html_math_renderer(
        "mathml", inline_renderers=(inline_math, None), block_renderers=(block_math, None)
    )


def plain_docstring(
    app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]
) -> None:
    """The kit's plain-text docstrings -> reStructuredText, in place.

    A paragraph of equations keeps its lines; elsewhere no character is markup but `code`.
    """
    if isinstance(obj, (int, float, str, tuple, dict, list)):
        lines[:] = []  # of the value's type, and no description of it
        return
    blocks: list[list[str]] = []
    for line in ["", *lines]:
        if not line.strip():
            blocks.append([])
        else:
            blocks[-1].append(line)
    blocks = [block for block in blocks if block]
    out: list[str] = []
    in_section = False
    for number, block in enumerate(blocks):
        head = block[0].strip()
        in_section |= bool(_HEAD.match(head))
        formula = all(map(_EQUATION.match, block)) and not block[-1].endswith(".")
        program = not in_section and all(line.startswith("  ") for line in block)
        if number and (program or (formula and not _HEAD.match(head))):
            text = dedent("\n".join(block)).replace("`", "")
            out += [
                ".. code-block:: text",
                "   :class: formula",
                "",
                *(f"   {line}" for line in text.split("\n")),
                "",
            ]
            continue
        if number == 0 and what in ("property", "attribute", "data"):
            block[0] = block[0].replace(": ", f"{_COLON} ")
        elif head in ("Returns:", "Yields:") and len(block) > 1:
            block[1] = re.sub(r":( |$)", rf"{_COLON}\1", block[1])
        out += [*map(escape, block), ""]
    lines[:] = out


def colons_again(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """The colons that plain_docstring took away."""
    lines[:] = [line.replace(_COLON, ":") for line in lines]


def skip_fields(app: Any, what: str, name: str, obj: Any, skip: bool, options: Any) -> bool | None:
    """A named tuple's fields are in its signature already."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def short_property(app: Any, domain: str, kind: str, content: Any) -> None:
    """A property's type as `short` writes it."""
    from docutils.nodes import Text
    from sphinx.addnodes import desc_annotation, pending_xref_condition

    for annotation in content.parent.findall(desc_annotation):
        if "ndarray" in annotation.astext():
            for other in [*annotation.findall(pending_xref_condition)]:
                if other["condition"] == "*":  # the same words again, for a name without a page
                    other.parent.remove(other)
            words = short(annotation.astext())
            annotation.children = []
            annotation += Text(words)


def line_ends(app: Any, page: str, template: str, context: Any, doctree: Any) -> None:
    """Where lines of a narrow page may end: in long names after a slash or underscore, and not
    within an option's hyphens and word, an arrow, or a short piece of code."""
    if "body" in context:
        context["body"] = with_line_ends(context["body"])


def with_line_ends(body: str) -> str:
    """HTML with marks for options, arrows and short code, and with breaks in long names."""

    def breaks(found: re.Match[str]) -> str:
        long = r"/+(?=[A-Za-z])|_+(?=[A-Za-z])|\.(?=[A-Za-z]{5})"
        marks = "/+(?=[A-Za-z])" if len(found[2]) < 17 else long
        return found[1] + re.sub(rf"(?<=\w)({marks})", r"\1<wbr>", found[2])

    def numbers(found: re.Match[str]) -> str:
        pieces = [f'<span class="option">{piece}</span>' for piece in found[2].split(",")]
        return found[1] + "<wbr>" + ",<wbr>".join(pieces)

    body = re.sub(
        r'(<span class="pre">\[?)(--[a-z][a-z0-9-]*)', r'\1<span class="option">\2</span>', body
    )
    body = re.sub(r'(class="option">--[a-z-]+</span>=)([-\d.]+(?:,[-\d.]+)+)', numbers, body)
    body = re.sub(
        r'(<code class=")([^"]*"><span class="pre">(?:[^<&]|&\w+;){1,16}</span></code>)',
        r"\1short \2",
        body,
    )
    body = re.sub(r'(<span class="pre">)([^<]{13,})', breaks, body)
    body = re.sub(r"(<strong>)([\w]{13,})(?=</strong>)", breaks, body)
    body = re.sub(r"(<h[1-3]>[^<]*?)([\w.]{17,})", breaks, body)
    body = re.sub(
        r"<code(?![^>]*docutils)[^>]*>.*?</code>",  # the builder's book
        lambda code: re.sub(r"()([\w./]{17,})(?![^<>]*>)", breaks, code[0]),
        body,
        flags=re.DOTALL,
    )
    arrow = r'<span class="option">\1</span>'
    return re.sub(r">[^<]+", lambda text: re.sub(r"((?:&lt;)?-&gt;)", arrow, text[0]), body)


def short_types(*arguments: Any) -> tuple[str | None, str | None]:
    """The signature and the result of Sphinx's event, with the kit's own names of types."""
    signature, result = arguments[-2:]
    return short_defaults(short(signature)), short(result)


def short_defaults(signature: str | None) -> str | None:
    """A signature whose long defaults, and those without a literal, are `...`."""
    if signature is None or not signature.startswith("("):
        return signature
    parts, depth, quote = [""], 0, ""
    for mark in signature[1:-1]:
        if quote:
            quote = "" if mark == quote and not parts[-1].endswith("\\") else quote
        elif mark in "'\"":
            quote = mark
        else:
            depth += (mark in "([{") - (mark in ")]}")
        if mark == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += mark
    shown = []
    for part in map(str.strip, parts):
        name, equals, default = part.partition("=")
        is_long = len(default.strip()) > _LONGEST or default.strip().startswith("<")
        shown.append(f"{name.strip()} = ..." if equals and is_long else part)
    return f"({', '.join(shown)})"


def short(text: str | None) -> str | None:
    """A signature in which no type carries its module, and arrays are `Array` and `ArrayLike`."""
    if text is None:
        return None
    text = re.sub(r"~(?:\w+\.)+(\w+)", r"\1", text)
    text = re.sub(
        r"(?:numpy\.)?ndarray\[(?:tuple\[)?Any(?:, \.\.\.\])?, dtype\[[^\]]+\]\]", "Array", text
    )
    last = r"_NestedSequence\[(?:bool \| int \| float \| )?complex \| bytes \| str\]"
    return re.sub(rf"(?:_Buffer \| )?_SupportsArray\[.*?{last}", "ArrayLike", text)


def escape(line: str) -> str:
    """A line whose asterisks, bars and trailing underscores are themselves, outside `code`."""
    parts = re.split(r"(`[^`]*`)", line.replace("``", "`"))
    return "".join(
        f"`{part}`"
        if k % 2 and len(part) > 2
        else re.sub(r"([\\*|])|(?<=\w)(_)(?!\w)", r"\\\1\2", part)
        for k, part in enumerate(parts)
    )


def inline_math(writer: Any, node: Any) -> None:
    """A formula in a line."""
    from docutils.nodes import SkipNode

    writer.body.append(mathml(node.astext(), block=False))
    raise SkipNode


def block_math(writer: Any, node: Any) -> None:
    """A formula on a line of its own."""
    from docutils.nodes import SkipNode

    formula = mathml(node.astext(), block=True)
    writer.body.append(f'<div class="math">{formula}</div>')
    raise SkipNode


def mathml(text: str, *, block: bool) -> str:
    """LaTeX -> MathML, which browsers draw by themselves, by docutils' own converter."""
    from docutils.utils.math.latex2mathml import tex2mathml

    text = re.sub(r"\\[bB]igg?l?([(\[])", r"\\left\1", text)  # MathML's brackets fit what they hold
    text = re.sub(r"\\[bB]igg?r?([)\]])", r"\\right\1", text)
    text = re.sub(r"\\text\{[^}]*\}", lambda words: words[0].replace(r"\_", "_"), text)
    text = text.replace("°", r"{}^\circ").replace(r"\texttt", r"\mathtt")
    text = re.sub(r"(\\[dt]?frac) ?(\d)([0-9a-zA-Z])", r"\1{\2}{\3}", text)  # else 12 is a number
    if block and r"\\" in text and r"\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    return label_below_brace(index_beside_accent(str(tex2mathml(text, as_block=block))))


def label_below_brace(formula: str) -> str:
    """MathML in which the brace below a sum is as wide as the sum, with its label below it."""
    pattern = r"<msub>(\s*<munder>.*?<mo)(>⏟</mo>\s*</munder>\s*<mtext>[^<]*</mtext>\s*)</msub>"
    return re.sub(pattern, r'<munder>\1 stretchy="true"\2</munder>', formula, flags=re.DOTALL)


def index_beside_accent(formula: str) -> str:
    """MathML in which an index of an accented letter stands beside it, not below it."""
    pattern = (
        r"<munderover>\s*(<mi>\w</mi>)\s*(<m[in]>[^<]+</m[in]>)"
        r'\s*(<mo stretchy="false">[ˆ˙ˉ˜]</mo>)\s*</munderover>'
    )
    return re.sub(pattern, r"<msub><mover>\1\3</mover>\2</msub>", formula)
