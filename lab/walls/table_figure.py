"""Picture of simulated walls beside the formula."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mirrorwave.plots.style import legend_below, legend_beside, new_figure, save

if TYPE_CHECKING:
    from lab.full_wave.reflectance import ReflectanceTable


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#E69F00", "#555555", "#CC79A7", "#56B4E9")


def draw_comparison(table: ReflectanceTable, path: Path) -> None:
    """Write a picture: specular gain of rough concrete in each band, and what all rough walls do beyond the formula."""
    figure = new_figure(10.0, 9.0)
    upper, lower = figure.subfigures(2, 1, squeeze=False).ravel()
    for panel, band in zip(upper.subplots(1, len(table.bands_hz)), table.bands_hz, strict=True):
        _draw_band(panel, table, band)
    panel, labelled = lower.subplots(), set[str]()
    _plain(panel)
    panel.axhspan(-0.5, 0.5, color="#EEEEEE")
    walls = dict(zip(table.walls, COLOURS * 3, strict=False))
    for comparison in table.compare():
        if comparison.roughness_m == 0.0 or not len(comparison.angles_deg):
            continue
        wavelength_m = 299_792_458.0 / comparison.frequency_hz
        phase = 4.0 * np.pi * comparison.roughness_m * np.cos(np.radians(comparison.angles_deg)) / wavelength_m
        mark = ("o" if comparison.polarisation == "te" else "s", walls[comparison.wall], comparison.frequency_hz < 50e9)
        label = f"{comparison.wall} {comparison.frequency_hz / 1e9:g} GHz {comparison.polarisation.upper()}"
        panel.errorbar(
            phase,
            comparison.difference_db,
            comparison.error_db,
            fmt=mark[0],
            color=mark[1],
            markersize=4.5,
            linewidth=0.8,
            markerfacecolor=mark[1] if mark[2] else "white",
            label="_" if label in labelled else label,
        )
        labelled.add(label)
    panel.set_title("rough walls: FDTD minus formula [dB]", fontsize=10)
    panel.set_xlabel("rms phase g = 4π s cos θ / λ [rad]")
    legend_beside(panel)
    save(figure, path)


def _draw_band(panel: Any, table: ReflectanceTable, band: float) -> None:
    """Concrete, TE: lines of the formula, marks of FDTD, a colour a roughness."""
    from models.physics.fresnel import coherent_power

    fine_deg = np.linspace(0.0, 85.0, 171)
    at = table.walls.index("concrete"), table.bands_hz.index(band), 0
    smooth = np.interp(fine_deg, table.smooth_angle_deg, np.square(np.abs(table.smooth_r[at])))
    rows = [
        comparison
        for comparison in table.compare()
        if (comparison.wall, comparison.frequency_hz, comparison.polarisation) == ("concrete", band, "te")
    ]
    for colour, comparison in zip(COLOURS, rows, strict=False):
        factor = coherent_power(np.asarray(comparison.roughness_m), np.cos(np.radians(fine_deg)), 299_792_458.0 / band)
        formula_db = 10.0 * np.log10(np.maximum(smooth * factor, 1e-9))
        panel.plot(fine_deg, formula_db, color=colour, linewidth=1.3, label=f"{1e3 * comparison.roughness_m:g} mm rms")
        here = slice(None, None, 10) if comparison.roughness_m == 0.0 else slice(None)
        at_deg = comparison.angles_deg[here]
        marks_db = np.interp(at_deg, fine_deg, formula_db) + comparison.difference_db[here]
        panel.errorbar(at_deg, marks_db, comparison.error_db[here], fmt="o", color=colour, markersize=4, label="_")
    panel.set_title(f"concrete, {band / 1e9:g} GHz, TE: specular gain [dB]", fontsize=10)
    panel.set_xlabel("angle of incidence [deg]")
    panel.set_ylim(-40.0, 1.0)
    _plain(panel)
    legend_below(panel, columns=len(rows), title="lines: formula, marks: FDTD", title_fontsize=9, fontsize=8)


def _plain(panel: Any) -> None:
    """Pale lines behind the data, no frame above and to the right of it."""
    panel.grid(color="#DDDDDD", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
