"""Symbols of quantities as mathtext, which matplotlib and xarray draw."""

import re
import unicodedata

_MATHTEXT_BY_SYMBOL = {
    "θ": r"\theta ", "κ": r"\kappa ", "λ": r"\lambda ", "μ": r"\mu ", "ρ": r"\rho ",
    "Δ": r"\Delta ", "σ": r"\sigma ", "∂": r"\partial ", "phi": r"\phi ", "min": r"\min ",
    "⁺": "^+", "⁻": "^-", "²": "^2", "*": "^*", "₀": "_0", "₁": "_1",
}  # fmt: skip
_SYMBOL_TOKEN_PATTERN = re.compile(
    r"_(?P<below>\w[\w-]*(?:, ?\w+)?)|(?P<dotted>\w)\u0307|(?P<twice>\w)\u0308"
    r"|(?P<word>[A-Za-z]{2,}(?:-I+)?)"
    r"|(?P<index>(?<=[^\W\d_]|\u0307|\u0308)\d)|(?P<sign>[^\s\d()|/,A-Za-z-])"
)


def format_mathtext(symbol_text: str) -> str:
    r"""Convert a symbol to mathtext: "θ̇⁺" to \dot{\theta}^+, "L1" to L_1."""

    def format_symbol_token(token_match: re.Match[str]) -> str:
        token_kind = token_match.lastgroup or ""
        token_text = token_match[token_kind]
        is_upright_text = token_kind == "word" or re.search("[A-Za-z]{3}", token_text)
        token_mathtext = _MATHTEXT_BY_SYMBOL.get(
            token_text, f"\\mathrm{{{token_text}}}" if is_upright_text else token_text
        )
        return {
            "below": f"_{{{token_mathtext}}}",
            "dotted": f"\\dot{{{token_mathtext}}}",
            "twice": f"\\ddot{{{token_mathtext}}}",
            "index": f"_{token_mathtext}",
        }.get(token_kind, token_mathtext)

    return _SYMBOL_TOKEN_PATTERN.sub(format_symbol_token, unicodedata.normalize("NFD", symbol_text))
