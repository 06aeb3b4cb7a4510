"""What holds for all tests."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

#: pytest's own, added to a relative one that is asked for.
DEFAULT_ABSOLUTE = 1e-12
#: Expected values under this are powers, photons or energies, no rounding about zero.
SMALL = 1e-6

_approx = pytest.approx


def approx(expected: Any, rel: float | None = None, abs: float | None = None, nan_ok: bool = False) -> Any:
    """`pytest.approx`, which refuses a relative tolerance that its default absolute one would swallow.

    A power of 1e-13 mW is equal to any other to within 1e-12: such a test cannot fail. It says `abs=0.0`.
    """
    is_relative = rel is not None and abs is None and isinstance(expected, float | complex | np.number)
    if is_relative and 0.0 < np.abs(expected) < SMALL and rel * np.abs(expected) < DEFAULT_ABSOLUTE:
        raise ValueError(
            f"approx({expected!r}, rel={rel!r}) needs abs=0.0: the default absolute tolerance, "
            f"{DEFAULT_ABSOLUTE:g}, is looser"
        )
    return _approx(expected, rel=rel, abs=abs, nan_ok=nan_ok)


pytest.approx = approx
