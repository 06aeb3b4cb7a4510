"""Cards: JSON files that say what a learned file is and how it was made."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

Card = TypeVar("Card")

#: Larger files are no cards.
MAX_CARD_BYTES = 1 << 24
#: Learned files that come with the code.
WEIGHTS = Path(__file__).parents[1] / "weights"


def learned_path(name: str | Path, ending: str) -> Path:
    """A learned file by its path; a name without the ending is that of one in `WEIGHTS`."""
    return Path(name) if str(name).endswith(ending) else WEIGHTS / f"{name}{ending}"


def card_path(model_path: Path) -> Path:
    """Where the card of a network file lies."""
    return model_path.with_suffix(".json")


def read_card(path: Path, kind: type[Card]) -> Card:
    """A card of a type; raises `ValueError` naming the file and the field that is wrong."""
    try:
        return msgspec.json.decode(read_learned(path, MAX_CARD_BYTES), type=kind)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_learned(path: Path, limit_bytes: int) -> bytes:
    """A whole learned file; raises `ValueError` naming one that cannot be read, is no file or larger than the limit."""
    try:
        size, is_file = path.stat().st_size, path.is_file()
        # before it is read: it would take the memory of all other nodes
        if is_file and size <= limit_bytes:
            return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error}") from None
    found = f"{size} bytes" if is_file else "none"
    raise ValueError(f"{path} must be a file of at most {limit_bytes} bytes, got {found}")
