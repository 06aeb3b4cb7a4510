"""Where the recorded captures are that some tests read: in `shared/data` beside the checkout or above.

`MIRRORWAVE_DATA` names another folder; whoever names it has the captures, and what it lacks fails.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from msgs.files.shipped import CHECKOUT

_ROOT = CHECKOUT
_NAMED = os.environ.get("MIRRORWAVE_DATA")


def found(root: Path) -> Path:
    """The folder of captures nearest to a checkout, which may not exist."""
    folders = [folder / "shared" / "data" for folder in (root, *root.parents)]
    return next((folder for folder in folders if folder.is_dir()), folders[1])


DATA = Path(_NAMED) if _NAMED else found(_ROOT)


def needs(capture: Path) -> pytest.MarkDecorator:
    """Skip a test by the name of its capture where that is absent."""
    return pytest.mark.skipif(not _NAMED and not capture.exists(), reason=f"{capture.relative_to(DATA)} is absent")
