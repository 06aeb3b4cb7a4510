"""The background that is taken off every beam, as `mirrorwave calibrate background` writes it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from msgs.files.array_files import load_array


def load_background(path: Path) -> np.ndarray:
    """Return the background [beams, samples] of a file; `ValueError` naming file and rule where it holds none."""
    try:
        background = load_array(path)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such background") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as .npy ({' '.join(str(error).split())})") from None
    if background.dtype.str != "<c8" or background.ndim != 2:
        raise ValueError(f"{path}: must hold complex64 [beams, samples]")
    if not np.isfinite(background).all():
        raise ValueError(f"{path}: must be finite")
    return background
