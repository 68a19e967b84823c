"""Terminals that lack letters: what they cannot show is spelled out, `0.158 +/- 0.003`.

A terminal without UTF-8 (`LC_ALL=C` on a cluster's node, an old console, `PYTHONIOENCODING=ascii`)
takes ASCII only, and Python would end in a traceback at the first `±` of a result that took hours.
"""

from __future__ import annotations

import codecs
import sys
import unicodedata

_SPELLED = {
    "±": "+/-", "×": "x", "·": "-", "…": "...", "–": "-", "—": "-", "−": "-", "→": "->",
    "≤": "<=", "≥": ">=", "≈": "~", "°": " deg", "µ": "u", "μ": "u", "²": "^2", "³": "^3",
    "‘": "'", "’": "'", "“": '"', "”": '"', "█": "#", "ρ": "rho", "θ": "theta", "φ": "phi",
    "ω": "omega", "π": "pi", "Δ": "Delta", "α": "alpha", "β": "beta", "σ": "sigma",
}  # fmt: skip
_NAME = "mjx_revolve_spell"


def spell(text: str) -> str:
    """A text in ASCII: signs in words, letters without accents, all else by its number."""
    return "".join(map(_letter, text))


def _letter(letter: str) -> str:
    if letter.isascii():
        return letter
    if letter in _SPELLED:
        return _SPELLED[letter]
    plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
    return plain or letter.encode("ascii", "backslashreplace").decode()


def _spell_rest(error: UnicodeError) -> tuple[str, int]:
    """What `codecs.register_error` asks for: a replacement, and where to go on."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return spell(error.object[error.start : error.end]), error.end


def spell_what_is_lacking() -> None:
    """Has stdout and stderr spell what their encoding lacks, from now on; all else stays."""
    codecs.register_error(_NAME, _spell_rest)
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)  # a test's or a notebook's has none
        if reconfigure is not None:
            reconfigure(errors=_NAME)
