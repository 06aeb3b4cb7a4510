"""What the foreign tracer's tests need."""

from __future__ import annotations

import pytest

from lab.foreign.sionna_tracer import ForeignTracerMissingError, load_sionna


def require_sionna() -> None:
    """Skip the test, with the reason, where the foreign tracer cannot run; inside the test, for its import is slow."""
    try:
        load_sionna()
    except ForeignTracerMissingError as error:
        pytest.skip(str(error))
