"""A home of its own for a run of tests: nothing of the user's is read or written, in no process that a test starts."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path

#: Set by the process that made the home, for its workers and what they start.
VARIABLE = "MIRRORWAVE_TESTS_HOME"
#: Where programs keep what belongs to their user, and the folder of it in the home.
FOLDERS = {
    "HOME": ".",
    "XDG_CACHE_HOME": ".cache",
    "XDG_CONFIG_HOME": ".config",
    "XDG_DATA_HOME": ".local/share",
    "XDG_STATE_HOME": ".local/state",
    # short: names of sockets are limited
    "XDG_RUNTIME_DIR": "r",
}
#: The list of fonts, which takes seconds to make: it outlasts the run, in the checkout.
FONTS = Path(__file__).parents[1] / ".pytest_cache" / "matplotlib"


def move_in() -> None:
    """Give this process, and all that it starts, the home of this run of tests; the first one makes and removes it."""
    home = os.environ.get(VARIABLE)
    if home is None:
        home = os.environ[VARIABLE] = tempfile.mkdtemp(prefix="mw", dir="/tmp")
        atexit.register(_remove, home, os.getpid())
    for name, folder in FOLDERS.items():
        path = Path(home) / folder
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        os.environ[name] = str(path)
    # where the user's shell has its graphs meet
    os.environ.pop("MIRRORWAVE_RUN_DIR", None)
    FONTS.mkdir(parents=True, exist_ok=True)
    os.environ["MPLCONFIGDIR"] = str(FONTS)


def _remove(home: str, owner: int) -> None:
    if os.getpid() == owner:
        shutil.rmtree(home, ignore_errors=True)
