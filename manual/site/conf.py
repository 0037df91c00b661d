"""Sphinx's settings for the site: staged sources -> HTML that loads nothing from the network.

`python manual/build.py site` stages the pages and calls Sphinx with this file.
"""

import re
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


def setup(app: Any) -> None:
    """Called by Sphinx: docstrings as the kit writes them, and formulas as MathML."""
    app.connect("autodoc-process-docstring", plain_docstring, priority=400)  # before napoleon's 500
    app.connect("autodoc-process-signature", short_types)
    app.connect("html-page-context", whole_options)
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
    blocks, block = [], []
    for line in [*lines, ""]:
        if line.strip():
            block.append(line)
        elif block:
            blocks.append(block)
            block = []
    out: list[str] = []
    for number, block in enumerate(blocks):
        if number and not _HEAD.match(block[0].strip()) and all(map(_EQUATION.match, block)):
            out += ["::", "", *(f"    {line}" for line in block), ""]
        else:
            out += [*map(escape, block), ""]
    lines[:] = out


def whole_options(app: Any, page: str, template: str, context: Any, doctree: Any) -> None:
    """Options in code, marked so that no line ends between their hyphens and their word."""
    if "body" in context:
        pattern = r'(<span class="pre">)(--[a-z][a-z0-9-]*)'
        context["body"] = re.sub(pattern, r'\1<span class="option">\2</span>', context["body"])


def short_types(*arguments: Any) -> tuple[str | None, str | None]:
    """The signature and the result of Sphinx's event, with the kit's own names of types."""
    signature, result = arguments[-2:]
    return short(signature), short(result)


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

    text = re.sub(r"\\[bB]igg?[lrm]?(?![a-zA-Z])", "", text)  # MathML's brackets grow by themselves
    text = text.replace("°", r"{}^\circ").replace(r"\texttt", r"\mathtt")
    text = re.sub(r"(\\[dt]?frac) ?(\d)([0-9a-zA-Z])", r"\1{\2}{\3}", text)  # else 12 is a number
    if block and r"\\" in text and r"\begin" not in text:
        text = rf"\begin{{aligned}}{text}\end{{aligned}}"
    return index_beside_accent(str(tex2mathml(text, as_block=block)))


def index_beside_accent(formula: str) -> str:
    """MathML in which an index of an accented letter stands beside it, not below it."""
    pattern = (
        r"<munderover>\s*(<mi>\w</mi>)\s*(<m[in]>[^<]+</m[in]>)"
        r'\s*(<mo stretchy="false">[ˆ˙ˉ˜]</mo>)\s*</munderover>'
    )
    return re.sub(pattern, r"<msub><mover>\1\3</mover>\2</msub>", formula)
