"""Replacement of characters that the encoding of a terminal lacks, such as ASCII or cp1252."""

import codecs
import io
import sys
import unicodedata

ERROR_HANDLER_NAME = "vrw_spell"
"""Name of the handler of encoding errors, chosen because no other library uses it."""

ASCII_SPELLINGS = {
    "α": "alpha", "θ": "theta", "κ": "kappa", "λ": "lambda", "μ": "mu", "ρ": "rho", "σ": "sigma",
    "φ": "phi", "Δ": "Delta ", "∂": "d", "\u0307": "'", "\u0308": "''", "²": "^2", "ᵀ": "^T",
    "·": ".", "−": "-", "→": "->", "≤": "<=", "≥": ">=", "≈": "~", "±": "+-", "’": "'",
    "“": '"', "”": '"', "§": "section ",
}  # fmt: skip
"""Replacements of the characters beyond ASCII that commands print."""


def spell_unencodable_characters() -> None:
    """Make standard output and standard error replace the characters that their encoding lacks."""
    codecs.register_error(ERROR_HANDLER_NAME, _spell_unencodable)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=ERROR_HANDLER_NAME)


def format_for_encoding(text: str, encoding: str) -> str:
    """Return the text as a terminal of that encoding shows it."""
    codecs.register_error(ERROR_HANDLER_NAME, _spell_unencodable)
    return text.encode(encoding, ERROR_HANDLER_NAME).decode(encoding)


def _spell_unencodable(error: UnicodeError) -> tuple[str, int]:
    """Return the replacement of characters that an encoding lacks, and the index after them."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_spell_in_ascii, error.object[error.start : error.end])), error.end


def _spell_in_ascii(character: str) -> str:
    """Return a character in ASCII: its replacement, or those of the characters of which it is
    composed.
    """
    if character.isascii() or character in ASCII_SPELLINGS:
        return ASCII_SPELLINGS.get(character, character)
    decomposed_characters = unicodedata.normalize("NFKD", character)
    if decomposed_characters == character:
        return "" if unicodedata.combining(character) else "?"
    return "".join(map(_spell_in_ascii, decomposed_characters))
