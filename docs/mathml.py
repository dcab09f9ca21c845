"""Formulas as MathML, which browsers draw themselves: no script, no network. A Sphinx extension.

The translation is docutils' own. What it does not know is a warning, and so an error of `make docs`.
"""

from __future__ import annotations

import html
import re
from typing import Any

from docutils import nodes
from docutils.utils.math import pick_math_environment, wrap_math_code
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

LOG = logging.getLogger(__name__)


def spell_out(code: str) -> str:
    r"""Commands that docutils does not know under the name that we use, and braces of fractions.

    It reads `\frac12 x` as twelve over x and says nothing.
    """
    for done in (r"(\\[td]?frac)", r"(\\[td]?frac\{[^{}]*\})"):
        code = re.sub(done + r"\s*([^\s{}\\]|\\[A-Za-z]+)", r"\1{\2}", code)
    return code.replace("\\dots", "\\ldots").replace("\\Big(", "\\Bigl(").replace("\\Big)", "\\Bigr)")


def as_tex_would(code: str) -> str:
    """What browsers would draw otherwise than TeX: upright capitals, a bar clear of its letter, norms, log x."""
    code = code.replace('class="capital-greek"', 'mathvariant="normal"').replace("\u02c9", "\u00af")
    code = re.sub(r"<mo( class=.\w+.)?>(?=\u2016)", r'<mo\1 stretchy="false">', code)
    return re.sub(r"<mo>&ApplyFunction;</mo>(?!\s*<mo)", '<mspace width="0.1667em"></mspace>', code)


def mathml(node: nodes.Element, block: bool) -> str:
    """MathML of a formula."""
    code = spell_out(node.astext().strip())
    if block and pick_math_environment(code) == "align*":  # lines of its own, outside of any environment
        code = wrap_math_code(code, True)
    try:
        return as_tex_would(tex2mathml(code, as_block=block))
    except Exception as error:
        LOG.warning("formula %r: %s", code, error, location=node)
        return f"<code>{html.escape(code)}</code>"


def visit_inline(translator: Any, node: nodes.Element) -> None:
    """A formula in a sentence."""
    translator.body.append(f'<span class="math">{mathml(node, block=False)}</span>')
    raise nodes.SkipNode


def visit_block(translator: Any, node: nodes.Element) -> None:
    """A formula on its own."""
    translator.body.append(f'<div class="math">{mathml(node, block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}
