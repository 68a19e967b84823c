"""Output on terminals without UTF-8: signs are spelled out, `0.158 +/- 0.003`.

Python would end in a traceback at the first `±` of a result that took hours (`LC_ALL=C` on a
cluster's node, an old console, `PYTHONIOENCODING=ascii`).
"""

from __future__ import annotations

import codecs
import sys
import unicodedata

_SPELLED = {
    "±": "+/-", "×": "x", "·": "-", "–": "-", "—": "-", "−": "-", "→": "->", "≤": "<=", "≥": ">=",
    "≈": "~", "°": " deg", "²": "^2", "³": "^3", "‘": "'", "’": "'", "“": '"', "”": '"', "█": "#",
}  # fmt: skip


def spell(text: str) -> str:
    """A text in ASCII: signs in words, letters without accents, all else by its number."""
    return "".join(map(_letter, text))


def _letter(letter: str) -> str:
    known = letter if letter.isascii() else _SPELLED.get(letter)
    if known is not None:
        return known
    name = unicodedata.name(letter, "")
    if name.startswith("GREEK "):
        return name.rpartition(" ")[2].lower()
    simple = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore")
    return (simple or letter.encode("ascii", "backslashreplace")).decode()


def _spell_rest(error: UnicodeError) -> tuple[str, int]:
    """An error handler of codecs: the replacement, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return spell(error.object[error.start : error.end]), error.end


def spell_unencodable() -> None:
    """Makes stdout and stderr spell what their encoding lacks."""
    codecs.register_error("mjx_revolve_spell", _spell_rest)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # a test's or a notebook's has none
            stream.reconfigure(errors="mjx_revolve_spell")
