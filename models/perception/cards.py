"""Cards: JSON files that say what a learned file is and how it was made."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

Card = TypeVar("Card")

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
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (msgspec.DecodeError, OSError) as error:
        raise ValueError(f"{path}: {error}") from None
