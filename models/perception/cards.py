"""Cards: JSON files that describe a learned file and how it was made."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import msgspec

from msgs.files.former_fields import without_former
from msgs.files.shipped import WEIGHTS
from msgs.files.text_files import decode_text
from msgs.values.known_names import with_known_names

Card = TypeVar("Card")

#: Larger files are no cards.
MAX_CARD_BYTES = 1 << 24


def learned_path(name: str | Path) -> Path:
    """Return a network's file by its path; a name without its ending is that of one in `WEIGHTS`."""
    return Path(name) if str(name).endswith(".onnx") else WEIGHTS / f"{name}.onnx"


def card_path(model_path: Path) -> Path:
    """Return where the card of a network file lies."""
    return model_path.with_suffix(".json")


def read_card(path: Path, kind: type[Card]) -> Card:
    """Return a card of a type; `ValueError` names the file and all fields that are missing, wrong or formerly other."""
    content = read_learned(path, MAX_CARD_BYTES)
    try:
        text = decode_text(content)
        if not hasattr(kind, "formerly"):
            return msgspec.json.decode(text, type=kind)
        values, former = without_former(msgspec.json.decode(text), kind)
        for field in former:
            if field.given != field.value:
                raise ValueError(f"{field.place} must be {field.value!r}, as {field.constant}, got {field.given!r}")
        text = msgspec.json.encode(values).decode()
        return msgspec.json.decode(text, type=kind)
    except msgspec.ValidationError as error:
        raise ValueError(f"{path}: {'; '.join(_wrong_fields(text, kind)) or error}") from None
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: {error}") from None


def _wrong_fields(text: str, kind: Any) -> list[str]:
    """Return all errors of a card, field by field: msgspec stops at the first."""
    try:
        values = msgspec.json.decode(text)
    except RecursionError as error:
        return [str(error)]
    if not isinstance(values, dict):
        return []
    fields = {field.encode_name: field for field in msgspec.structs.fields(kind)}
    missing = [name for name, field in fields.items() if field.required and name not in values]
    wrong = [f"lacks {', '.join(missing)}"] if missing else []
    for name in (name for name in fields if name in values):
        try:
            msgspec.convert(values[name], fields[name].type)
        except msgspec.ValidationError as error:
            wrong.append(f"{name}: {with_known_names(error, fields[name].type)}")
    return wrong


def read_learned(path: Path, limit_bytes: int) -> bytes:
    """Return a whole learned file; `ValueError` naming one that cannot be read, is no file or exceeds the limit."""
    try:
        size, is_file = path.stat().st_size, path.is_file()
        # check before reading: a larger file would take the memory of other nodes
        if is_file and size <= limit_bytes:
            return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    actual = f"{size} bytes" if is_file else "none"
    raise ValueError(f"{path} must be a file of at most {limit_bytes} bytes, got {actual}")
