"""Location of the files that come with the project: the one module that knows where checkout or installation is."""

from __future__ import annotations

from pathlib import Path

#: Folder that holds the packages and `launch/`: the checkout, or what an installation keeps in place of one.
CHECKOUT = Path(__file__).resolve().parents[2]
LAUNCH = CHECKOUT / "launch"
#: A short drive past hidden cars, simulated: raw beams, vehicle states and truth (docs/guides/first-look.md).
SAMPLE = LAUNCH / "samples" / "side_street.mcap"
WEIGHTS = CHECKOUT / "models" / "weights"
#: What benchmarks measured, as pages and as files that the program reads.
RESULTS = CHECKOUT / "docs" / "results"


def shipped_path(name: str | Path) -> Path:
    """Return a path as named, or the shipped file of that name where the working folder has none."""
    path = Path(name)
    shipped = CHECKOUT / path
    return shipped if shipped.exists() and not path.exists() else path
