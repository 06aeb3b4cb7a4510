"""Tables of simulated walls beside the formula that the ray tracer uses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mirrorwave.console import progress_bar
from msgs.values.wording import counted

if TYPE_CHECKING:
    from lab.full_wave.reflectance import Comparison, ReflectanceTable


def as_document(table: ReflectanceTable) -> dict[str, Any]:
    """Card, comparison and absent cells as plain values."""
    keys = ("wall", "frequency_hz", "polarisation", "roughness_m", "angle_deg", "reason")
    return {
        "card": table.card,
        "comparison": [_comparison_row(comparison) for comparison in table.compare()],
        "absent": [dict(zip(keys, row, strict=True)) for row in table.absent()],
    }


def rebuild_table(path: Path, workers: int) -> None:
    """Build a table and write it; what is done lies beside it until all is."""
    from lab.full_wave.reflectance import build_tables, table_entries

    if not path.absolute().parent.is_dir():
        raise NotADirectoryError(20, "its directory does not exist", str(path))
    partial = path.with_suffix(".cells.jsonl")
    with progress_bar("cells of walls") as progress:
        table = build_tables(table_entries(), progress.update, partial, workers)
    table.save(path, provenance(workers))
    partial.unlink(missing_ok=True)


def provenance(workers: int) -> dict[str, Any]:
    """Return the origin of a table: command, version of the code, kind of machine, day."""
    import os
    import platform
    from datetime import UTC, datetime

    return {
        "command": "mirrorwave sim reflectance --rebuild",
        "version": _version(),
        "machine": f"{platform.system()} {platform.machine()}, {counted(os.cpu_count() or 1, 'core')}, "
        f"{counted(workers, 'process')}",
        "date": datetime.now(UTC).date().isoformat(),
    }


def _version() -> str:
    """Return git's name of this checkout; "unknown" outside of one."""
    import subprocess

    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _comparison_row(comparison: Comparison) -> dict[str, Any]:
    worst_db, error_db, angle_deg = comparison.worst
    return {
        "wall": comparison.wall,
        "frequency_hz": comparison.frequency_hz,
        "polarisation": comparison.polarisation,
        "roughness_m": comparison.roughness_m,
        "worst_db": worst_db,
        "worst_error_db": error_db,
        "worst_angle_deg": angle_deg,
        "angles": len(comparison.angles_deg),
        "within_half_db": comparison.agreeing,
        "absent": comparison.absent,
    }
