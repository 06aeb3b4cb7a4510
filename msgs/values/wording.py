"""Numbers in sentences, and names of files in texts."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a count with its noun in English: "1 scan", "2 scans", "0 scans"; `plural` if an ending does not do."""
    ending = "es" if noun.endswith(("s", "x", "ch", "sh")) else "s"
    return f"{count} {noun if count == 1 else plural or noun + ending}"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the known name that `name` is a part or a slip of, "" where there is none."""
    names = list(known)
    ends = [other for other in names if other.replace("/", ".").rpartition(".")[2] == name]
    near = difflib.get_close_matches(name, names, 1) or difflib.get_close_matches(name.lower(), names, 1)
    parts = [other for other in names if name.lower() in other.lower()] if len(name) > 2 else []
    return f"; did you mean {best!r}?" if (best := next(iter([*ends, *near, *parts]), "")) else ""


def duration_text(seconds: float) -> str:
    """Return a duration as "4 s", "2 min 05 s", "1 h 02 min"."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def as_utf8(text: str) -> str:
    r"""Return a text that can be written as UTF-8: bytes of a file's name that are none as `\xNN`."""
    try:
        text.encode()
    except UnicodeEncodeError:
        try:
            return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
        except UnicodeEncodeError:
            return text.encode("utf-8", "backslashreplace").decode()
    return text
