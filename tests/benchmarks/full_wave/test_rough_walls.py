"""The judge of diffuse lobes: its laws share out the power, its strips are kept, and its page says what was found."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pytest

from benchmarks.full_wave import lobe
from benchmarks.full_wave.comparison import Roughness
from benchmarks.full_wave.page import RoughWalls, page
from benchmarks.full_wave.scenes import RADAR, ROUGH_M
from benchmarks.simulator.diffuse_lobe import change_of, with_lobe
from models.physics.roughness import diffuse_share
from sim_player.scene.description import scene_from_yaml

#: Sines of the orders of a strip so wide.
ORDERS = np.arange(-16, 17) * RADAR.wavelength_m / lobe.WIDTH_M


@pytest.mark.parametrize("roughness_m", ROUGH_M.values())
def test_lobes_share_out_what_roughness_takes(roughness_m: float) -> None:
    """Analytic: 1 - rho over all orders but the mirror's own; 2 % (a sum over 33 orders)."""
    taken = float(diffuse_share(np.asarray(roughness_m), np.asarray(1.0), RADAR.wavelength_m))
    lambert, kirchhoff = lobe._laws(roughness_m, ORDERS)
    assert kirchhoff.sum() == pytest.approx(taken, rel=0.02)
    # the cosine law ends at grazing, where orders are few
    assert lambert.sum() == pytest.approx(taken, rel=0.1)


def test_a_wave_that_is_kirchhoffs_lobe_is_no_error(tmp_path: Path) -> None:
    """Strips kept on disk are read, not computed: twice the lobe's power lies 3 dB over it."""
    for roughness_m in ROUGH_M.values():
        _, power = lobe._laws(roughness_m, ORDERS)
        for draw in (5, 6):
            np.save(tmp_path / f"strip-{1e3 * roughness_m:g}-{draw}.npy", np.stack([ORDERS, 2.0 * power]))
    rows = lobe.lobe_rows(2, 5, tmp_path)
    assert [row.roughness_mm for row in rows[::7]] == [1e3 * roughness_m for roughness_m in ROUGH_M.values()]
    for row in rows:
        assert row.kirchhoff_db == pytest.approx(-3.0103, abs=1e-4)
        assert row.error_db == pytest.approx(0.0, abs=1e-9)


def test_page_names_the_lobes() -> None:
    row = lobe.LobeRow(2.0, 24, (20, 30), -10.8, 0.5, 0.5, -0.6)
    change = {"p10": 0.1, "p50": 0.2, "p90": 0.3}
    names = ("share_over_1_db", "diffuse_db", "oblique_db")
    places = {"places": 40, "seed": 3, "maps_over_1_db": 39, **dict.fromkeys(names, change)}
    options = argparse.Namespace(cells=20.0, seed=0, seeds=24)
    wall = Roughness(
        about="a rough wall",
        draws=24,
        mean_db=-4.5,
        kirchhoff_db=-3.05,
        mean_error_db=1.65,
        power_db=-1.38,
        diffuse_db=-22.1,
        diffuse_error_db=0.7,
        lobes_db={"lambert": -8.0, "kirchhoff": -23.0},
    )
    assert "Kirchhoff" not in page([], [], RoughWalls([], [row], places), options)
    text = page([], [], RoughWalls([wall], [row], places), options)
    assert "| 2 | 20-30 | -10.8 +- 0.5 | +0.5 | -0.6 |" in text
    assert "| back from 20 to 33 deg, power | -22.1 +- 0.7 | -8.0 (Lambert), -23.0 (Kirchhoff) |" in text
    assert "In 39 of 40 maps" in text


def test_other_lobe_changes_places_with_rough_walls_alone() -> None:
    """A smooth wall has no lobe to change; of a rough one, oblique to the radar, nearly all power goes."""
    text = "name: w\nsurfaces: [{{role: relay, material: brick, polyline_m: [[9, 8], [14, -2]], roughness_mm: {}}}]"
    smooth, rough = (change_of(scene_from_yaml(text.format(height)), 0) for height in (0, 2))
    assert (smooth["largest_change_db"], smooth["diffuse_db"]) == (0.0, None)
    assert rough["largest_change_db"] > 1.0
    assert rough["oblique_db"] < -3.0
    (surface,) = with_lobe(scene_from_yaml(text.format(1)), "kirchhoff").surfaces
    assert surface.diffuse_lobe == "kirchhoff"
