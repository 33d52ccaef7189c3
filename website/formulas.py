"""Formulas in pages: TeX between dollars, and symbols of prose, become MathML for browsers.

No script, no font and no other host: MathML is part of HTML.
"""

import re
import unicodedata
from xml.etree.ElementTree import Element

from latex2mathml.converter import convert
from markdown import Markdown
from markdown.extensions import Extension
from markdown.inlinepatterns import InlineProcessor

from vrw_jax.base import format_mathtext

DISPLAYED = r"(?s)\$\$(.+?)\$\$"
INLINE = r"(?<![\\$\w])\$(?=[^\s$])([^$]+?)(?<=[^\s\\])\$(?![\w$])"
_BASE = "[A-Za-zα-ωΑ-Ω]"
_DOTTED = "(?:[A-Za-zα-ωΑ-Ω][\u0307\u0308]|[\u1e8b\u1e8d\u017c\u0116\u1e60\u1e8f])"
_END = "[⁺⁻²]?"
SYMBOL = (
    r"(?<![\w\\$.])((?:Δ|∂)?(?:"
    rf"{_DOTTED}(?:_?[\dI]+|[₀-₉]+)?{_END}"  # θ̇⁺, L̇1, ż2
    rf"|{_BASE}_(?:[A-Z][\w-]*|\d+|[a-z](?!\w)|stop|max|min){_END}"  # λ_I4, T_DLS, M_h
    rf"|{_BASE}[₀-₉ⱼ]+{_END}"  # λ₄⁺, L₀, M₁₁
    rf"|{_BASE}[⁺⁻]"  # θ⁻
    rf"|[α-ω]\d{_END}"  # λ4⁺
    r"))(?![\w\u0307\u0308])"
)
"""Pattern of a symbol in prose that is written in Unicode."""
_LOW = re.compile("[₀-₉ⱼ]+")
_DIGITS = {ord(low): digit for low, digit in zip("₀₁₂₃₄₅₆₇₈₉ⱼ", "0123456789j", strict=True)}
_GREEK = {ord("α"): r"\alpha ", ord("φ"): r"\phi ", ord("ε"): r"\varepsilon "}


def mathml(tex: str, *, block: bool = False) -> str:
    """Return TeX as a `<math>` element."""
    return convert(tex, display="block" if block else "inline")


def typeset(symbol: str) -> str:
    """Return the TeX of a symbol that is written in Unicode, such as λ₄⁺."""
    indexed = _LOW.sub(lambda low: "_" + low[0].translate(_DIGITS), symbol)
    return format_mathtext(unicodedata.normalize("NFD", indexed)).translate(_GREEK)


class _Formula(InlineProcessor):
    def __init__(self, pattern: str, md: Markdown, *, block: bool) -> None:
        InlineProcessor.__init__(self, pattern, md)
        self.block = block

    def handleMatch(
        self, m: re.Match[str], data: str
    ) -> tuple[Element | str | None, int | None, int | None]:
        element = mathml(m[1].strip(), block=self.block)
        if self.block:  # the style sheet makes a long one scroll
            element = f'<span class="formula">{element}</span>'
        return self.md.htmlStash.store(element), m.start(0), m.end(0)


class _Symbol(InlineProcessor):
    def handleMatch(
        self, m: re.Match[str], data: str
    ) -> tuple[Element | str | None, int | None, int | None]:
        return self.md.htmlStash.store(mathml(typeset(m[1]))), m.start(0), m.end(0)


class Formulas(Extension):
    """Formulas, processed after code, which keeps its dollars, and before emphasis."""

    def extendMarkdown(self, md: Markdown) -> None:
        md.inlinePatterns.register(_Formula(DISPLAYED, md, block=True), "displayed", 186)
        md.inlinePatterns.register(_Formula(INLINE, md, block=False), "formula", 185)
        md.inlinePatterns.register(_Symbol(SYMBOL, md), "symbol", 100)


def makeExtension(**settings: object) -> Formulas:
    """Return the extension; Python-Markdown requires this function."""
    return Formulas(**settings)
