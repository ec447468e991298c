"""Formulas as MathML, made while the site is built: pages need neither a script nor a network to show them."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError


def mathml(latex: str, display: str) -> str:
    """The formula as a ``<math>`` element; ExtensionError where the converter leaves something that is none.

    It passes on what it does not know (``aligned``, for instance), which browsers would show as bare text.
    """
    found: str = convert(latex, display=display)
    try:
        ElementTree.fromstring(found)
    except ElementTree.ParseError as error:
        raise ExtensionError(f"{latex!r} becomes no MathML ({error}): write it with 'align' or 'array'") from None
    return found


def _inline(translator: Any, node: nodes.math) -> None:
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def _block(translator: Any, node: nodes.math_block) -> None:
    translator.body.append(translator.starttag(node, "div", CLASS="math-block"))
    if node["number"]:
        translator.body.append(f'<span class="eqno">({node["number"]})</span>')
    translator.body.append(mathml(node.astext(), "block") + "</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer ``mathml``."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
