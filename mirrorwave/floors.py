"""Packages of the floors below: beside this one in a checkout, inside it in an installation.

Their names are common ones (`models`, `nodes`). An installation keeps them within `mirrorwave/floors_below/`: it shares
no file with other distributions. That folder comes first on the path: no package of the same name takes their place.
"""

from __future__ import annotations

import sys
from pathlib import Path

FLOORS = ("msgs", "models", "sim_player", "nodes", "lab", "contrib")
_INSTALLED = Path(__file__).resolve().parent / "floors_below"
#: Folder that holds them.
FOLDER = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1]


def use_own_floors() -> None:
    """Put the floors first on the path; raises `ImportError` where another package has one of their names already."""
    if sys.path[:1] != [str(FOLDER)]:
        sys.path.insert(0, str(FOLDER))
    for name in FLOORS:
        loaded = sys.modules.get(name)
        origin = getattr(loaded, "__file__", None)
        if loaded is not None and (origin is None or Path(origin).resolve().parent != FOLDER / name):
            raise ImportError(
                f"mirrorwave has a package {name!r} of its own, and another one is loaded already, from "
                f"{origin or 'a folder without __init__.py'}: import mirrorwave first, or rename the other"
            )
