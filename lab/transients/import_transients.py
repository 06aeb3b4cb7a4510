"""`mirrorwave import transients`: a confocal scan of a wall as the hidden surface, in pictures and figures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lab.transients.confocal import read_confocal
from lab.transients.light_cone import DEFAULT_SNR, Falloff, reconstruct
from lab.transients.scan import ConfocalTransients
from lab.transients.shape import HiddenShape, hidden_shape
from msgs.files.checksums import file_sha256, json_lines
from msgs.files.whole_files import whole, write_whole
from msgs.values.wording import as_utf8


def import_transients(capture: Path, out: Path, bin_s: float, min_range_m: float, falloff: Falloff) -> dict[str, Any]:
    """Write `hidden.png`, `hidden.npz` (brightness, depth_m, wall_m) and, last, `summary.json`; returns the summary.

    Raises `ValueError` where `out` holds something, for a file that cannot be read, and for parameters out of range.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out}: must be a new or an empty folder")
    if not math.isfinite(min_range_m) or min_range_m < 0.0:
        raise ValueError(f"min_range_m must be finite and not negative, got {min_range_m!r}")
    scan = read_confocal(capture, bin_s)
    first_bin = scan.bin_at(min_range_m)
    try:
        shape = hidden_shape(reconstruct(scan, first_bin, falloff), scan)
    except ValueError as error:
        raise ValueError(f"{capture}: {error}") from None
    out.mkdir(parents=True, exist_ok=True)
    draw_shape(shape, scan, out / "hidden.png", as_utf8(capture.name))
    with whole(out / "hidden.npz") as part, part.open("wb") as file:
        np.savez(file, brightness=shape.brightness, depth_m=shape.depth_m, wall_m=scan.wall_m)
    summary = {
        "points": list(scan.counts.shape[:2]),
        "bins": scan.bins,
        "bin_s": scan.bin_s,
        "half_width_m": scan.half_width_m,
        "photons": int(scan.counts.sum(dtype=np.uint64)),
        "hidden_photons": int(scan.counts[..., first_bin:].sum(dtype=np.uint64)),
        "min_range_m": min_range_m,
        "falloff": falloff,
        "snr": DEFAULT_SNR,
        "distance_m": shape.distance_m,
        "tilt_deg": math.degrees(shape.tilt_rad),
        "plane": {"depth_m": shape.plane[0], "slopes": list(shape.plane[1:])},
        "lit_share": float(shape.lit.mean()),
        "provenance": {"name": capture.name, "bytes": capture.stat().st_size, "sha256": file_sha256(capture)},
    }
    write_whole(out / "summary.json", json_lines(summary))
    return summary


def draw_shape(shape: HiddenShape, scan: ConfocalTransients, out_path: Path, name: str) -> None:
    """The hidden surface as the wall sees it: brightness, and depth of what is lit."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    reach_m = scan.half_width_m
    panels = (
        (shape.brightness, "brightness", "gray"),
        (np.where(shape.lit, shape.depth_m, np.nan), "distance from the wall [m]", "cividis"),
    )
    for axes, (values, label, colours) in zip(figure.subplots(1, 2), panels, strict=True):
        image = axes.imshow(values, cmap=colours, extent=(-reach_m, reach_m, reach_m, -reach_m))
        figure.colorbar(image, ax=axes, label=label)
        axes.set(xlabel="y [m]", ylabel="x [m]")
    figure.suptitle(f"{name}: hidden surface, {shape.distance_m:.3f} m from the wall")
    with whole(out_path) as part, part.open("wb") as file:
        figure.savefig(file, format="png", dpi=110, metadata={"Software": None})
