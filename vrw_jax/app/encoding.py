"""Replacement of characters that the encoding of a terminal, such as ASCII or cp1252, lacks."""

import codecs
import io
import sys
import unicodedata

ENCODING_ERROR_HANDLER_NAME = "vrw_spell"
"""Name of the handler for encoding errors, chosen because no other library uses it."""

ASCII_REPLACEMENTS = {
    "α": "alpha", "θ": "theta", "κ": "kappa", "λ": "lambda", "μ": "mu", "ρ": "rho", "σ": "sigma",
    "φ": "phi", "Δ": "Delta ", "∂": "d", "\u0307": "'", "\u0308": "''", "²": "^2", "ᵀ": "^T",
    "·": ".", "−": "-", "→": "->", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "’": "'",
    "“": '"', "”": '"', "§": "section ",
}  # fmt: skip
"""ASCII replacements for the other characters that commands print."""


def replace_unencodable_output() -> None:
    """Replace, in standard output and standard error, characters that the stream's encoding
    lacks.
    """
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    for output_stream in (sys.stdout, sys.stderr):
        if isinstance(output_stream, io.TextIOWrapper):
            output_stream.reconfigure(errors=ENCODING_ERROR_HANDLER_NAME)


def replace_unencodable_characters(printed_text: str, encoding_name: str) -> str:
    """Return a text in which all characters that the encoding lacks are replaced."""
    codecs.register_error(ENCODING_ERROR_HANDLER_NAME, _handle_encoding_error)
    return printed_text.encode(encoding_name, ENCODING_ERROR_HANDLER_NAME).decode(encoding_name)


def _handle_encoding_error(encoding_error: UnicodeError) -> tuple[str, int]:
    """Return the replacement for characters that an encoding lacks, and the index after them."""
    if not isinstance(encoding_error, UnicodeEncodeError):
        raise encoding_error
    return "".join(
        map(_replace_with_ascii, encoding_error.object[encoding_error.start : encoding_error.end])
    ), encoding_error.end


def _replace_with_ascii(unencodable_character: str) -> str:
    """Return an ASCII text for a character: its replacement, or replacements of its components."""
    if unencodable_character.isascii() or unencodable_character in ASCII_REPLACEMENTS:
        return ASCII_REPLACEMENTS.get(unencodable_character, unencodable_character)
    decomposed_characters = unicodedata.normalize("NFKD", unencodable_character)
    if decomposed_characters == unencodable_character:
        return "" if unicodedata.combining(unencodable_character) else "?"
    return "".join(map(_replace_with_ascii, decomposed_characters))
