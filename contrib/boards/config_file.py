"""Configuration files of 77 GHz boards, by their suffix."""

from __future__ import annotations

from pathlib import Path

from contrib.boards.dca1000_capture import Dca1000Config, DeviceName, parse_cfg, parse_json
from contrib.boards.mmwave_studio import parse_lua
from msgs.files.text_files import AS_CP1252, decode_text

#: Longer files are no configuration.
MAX_CONFIG_BYTES = 1 << 20


def read_config(path: Path, device: DeviceName | None) -> Dca1000Config:
    """Return the configuration of a `.json`, a `.lua` of mmWave Studio or, by any other suffix, a TI `.cfg`.

    Raises `ValueError` that begins with the path, `OSError` where it cannot be read.
    """
    with path.open("rb") as file:
        content = file.read(MAX_CONFIG_BYTES + 1)
    if len(content) > MAX_CONFIG_BYTES:
        raise ValueError(f"{path}: a configuration holds at most {MAX_CONFIG_BYTES} bytes")
    try:
        text = decode_text(content, AS_CP1252)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if path.suffix.lower() == ".json":
        return parse_json(text, str(path), device)
    parse = parse_lua if path.suffix.lower() == ".lua" else parse_cfg
    return parse(text, str(path), device)
