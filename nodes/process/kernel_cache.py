"""Place of compiled kernels where neither the installation nor the user's home can be written, as for a service."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

from msgs.files.shipped import CHECKOUT

#: Where numba keeps kernels, if set.
VARIABLE = "NUMBA_CACHE_DIR"


def can_write(folder: Path) -> bool:
    """Return whether this user may write into a folder, or into the nearest one above that exists."""
    while not folder.exists():
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)


def fallback_folder(environment: Mapping[str, str], may_write: Callable[[Path], bool] = can_write) -> Path | None:
    """Return the user's own folder under the temporary one, or None where numba finds a place by itself."""
    caches = Path(environment.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if environment.get(VARIABLE) or may_write(CHECKOUT) or may_write(caches):
        return None
    return Path(tempfile.gettempdir()) / f"mirrorwave-{os.getuid()}" / "kernels"


def use_fallback() -> None:
    """Have numba, here and in processes started from here, keep kernels in the fallback folder where it needs one.

    Raises `ValueError` or `OSError` where the folder is not safe or cannot be made.
    """
    folder = fallback_folder(os.environ)
    if folder is None:
        return
    # kernels are code: a folder that others could write into is refused, as that of a graph's sockets is
    from msgs.bus.zmq import make_run_dir

    make_run_dir(folder)
    os.environ[VARIABLE] = str(folder)
