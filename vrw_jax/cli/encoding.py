"""Replacement of characters that the encoding of a terminal lacks, such as ASCII or cp1252."""

import codecs
import io
import sys
import unicodedata

ENCODING_ERROR_HANDLER_NAME = "vrw_spell"
"""Name of the handler of encoding errors, chosen because no other library uses it."""

ASCII_REPLACEMENTS = {
    "α": "alpha", "θ": "theta", "κ": "kappa", "λ": "lambda", "μ": "mu", "ρ": "rho", "σ": "sigma",
    "φ": "phi", "Δ": "Delta ", "∂": "d", "\u0307": "'", "\u0308": "''", "²": "^2", "ᵀ": "^T",
    "·": ".", "−": "-", "→": "->", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "’": "'",
    "“": '"', "”": '"', "§": "section ",
}  # fmt: skip
"""Replacements of the characters beyond ASCII that commands print."""


def replace_unencodable_output() -> None:
    """Replace characters that its encoding lacks in standard output and standard error."""
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    for output_stream in (sys.stdout, sys.stderr):
        if isinstance(output_stream, io.TextIOWrapper):
            output_stream.reconfigure(errors=ENCODING_ERROR_HANDLER_NAME)


def replace_unencodable_characters(text: str, encoding_name: str) -> str:
    """Return the text with replacements of all characters that the encoding lacks."""
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    return text.encode(encoding_name, ENCODING_ERROR_HANDLER_NAME).decode(encoding_name)


def _handle_encoding_error(encoding_error: UnicodeError) -> tuple[str, int]:
    """Return the replacement of characters that an encoding lacks, and the index after them."""
    if not isinstance(encoding_error, UnicodeEncodeError):
        raise encoding_error
    return "".join(
        map(_replace_with_ascii, encoding_error.object[encoding_error.start : encoding_error.end])
    ), encoding_error.end


def _replace_with_ascii(character: str) -> str:
    """Return a character in ASCII: its replacement, or the replacements of its components."""
    if character.isascii() or character in ASCII_REPLACEMENTS:
        return ASCII_REPLACEMENTS.get(character, character)
    decomposed_characters = unicodedata.normalize("NFKD", character)
    if decomposed_characters == character:
        return "" if unicodedata.combining(character) else "?"
    return "".join(map(_replace_with_ascii, decomposed_characters))
