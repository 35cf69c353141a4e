"""Text for LaTeX."""

from __future__ import annotations

_COMMANDS = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#",
    "_": r"\_", "%": r"\%", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", '"': r"\textquotedbl{}",
    "−": "$-$", "–": "--", "½": r"$\frac12$", "ε": r"$\varepsilon$", "†": r"$^\dagger$",
    "τ": r"$\tau$", "ν": r"$\nu$", "≥": r"$\geq$", "±": r"$\pm$", "’": "'", "*": "$^*$",
}  # fmt: skip


def escape_latex(text: str) -> str:
    """Text as LaTeX source that prints it literally; the symbols of our labels become mathematics.

    Line ends remain: text of unknown origin must be put on one line before.
    """
    escaped = "".join(_COMMANDS.get(letter, letter) for letter in text.replace("r̃", "\0"))
    return escaped.replace("\0", r"$\tilde r$")
