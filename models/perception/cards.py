"""Cards: JSON files that say what a learned file is and how it was made."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

Card = TypeVar("Card")


def card_path(model_path: Path) -> Path:
    """Where the card of a network file lies."""
    return model_path.with_suffix(".json")


def read_card(path: Path, kind: type[Card]) -> Card:
    """A card of a type; raises `ValueError` naming the file and the field that is wrong."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.DecodeError, OSError) as error:
        raise ValueError(f"{path}: {error}") from None
