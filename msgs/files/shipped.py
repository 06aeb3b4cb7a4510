"""Location of the files that come with the project: the one module that knows where the checkout is."""

from __future__ import annotations

from pathlib import Path

#: Folder that holds the packages, `launch/` and `pyproject.toml`.
CHECKOUT = Path(__file__).resolve().parents[2]
LAUNCH = CHECKOUT / "launch"
WEIGHTS = CHECKOUT / "models" / "weights"
#: What benchmarks measured, as pages and as files that the program reads.
RESULTS = CHECKOUT / "docs" / "results"
