"""Shell completion of the sets of `eval --objects`."""

from __future__ import annotations

from mirrorwave.completion import beginning


def complete_object_sets(incomplete: str) -> list[str]:
    """Names of the committed sets of `eval --objects`."""
    from lab.evaluate.place_runs import read_sets

    return beginning(read_sets().sets, incomplete)
