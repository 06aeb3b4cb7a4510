"""Walls in question: units, layers, bands, limits of the wave simulation; the levels of an answer."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lab.walls import wall_question as wall
from lab.walls.curves import answer, field_db, note_and_error
from lab.walls.wall_question import Method, Wall, check_fdtd, known_bands, title_of, total_thickness_m
from models.physics.attenuation import vegetation_db


def asked(
    name: str,
    thickness_mm: float | None = None,
    roughness_mm: float = 0.0,
    method: Method = Method.EXACT,
    extrapolate: bool = False,
) -> Wall:
    return wall.wall_of(name, thickness_mm, roughness_mm, method, extrapolate)


def test_options_are_millimetres_and_walls_metres() -> None:
    concrete, double = asked("concrete", 120.0, 2.0), asked("double_glazing")
    assert (concrete.thickness_m, concrete.roughness_m) == (0.12, 0.002)
    assert (total_thickness_m(concrete), total_thickness_m(asked("concrete"))) == (0.12, None)
    assert total_thickness_m(double) == pytest.approx(0.024)
    assert title_of(double) == "double_glazing (4 mm glass + 16 mm vacuum + 4 mm glass)"
    assert (title_of(concrete), title_of(asked("concrete"))) == ("concrete (120 mm)", "concrete (half-space)")


@pytest.mark.parametrize(("roughness_mm", "limit_deg"), [(0.0, 89.0), (1.0, 70.0)])
def test_the_wave_simulation_ends_at_an_angle(roughness_mm: float, limit_deg: float) -> None:
    simulated = asked("concrete", 120.0, roughness_mm, method=Method.FDTD)
    check_fdtd(simulated, limit_deg)
    with pytest.raises(ValueError, match=f"must end at {limit_deg:g} at most"):
        check_fdtd(simulated, limit_deg + 0.1)
    check_fdtd(asked("concrete", 120.0, roughness_mm), 90.0)


def test_bands_outside_the_table_are_left_out_unless_all_are_or_extrapolated() -> None:
    """Wood is measured to 100 GHz."""
    assert known_bands(asked("wood"), (10.0, 300.0)) == (10.0,)
    assert known_bands(asked("wood"), (300.0,)) == (300.0,)
    assert known_bands(asked("wood", extrapolate=True), (10.0, 300.0)) == (10.0, 300.0)


def test_foliage_is_crossed_by_the_slanted_way() -> None:
    """At 60 deg a hedge of 1 m is 2 m deep; along it no further than a hundred times its depth."""
    curves = answer(asked("vegetation", 1000.0), 10e9, np.array([0.0, 60.0, 90.0])).te
    lost_db = [vegetation_db(10e9, np.array(depth_m)) for depth_m in (1.0, 2.0, 100.0)]
    np.testing.assert_allclose(-field_db(curves.t), lost_db, rtol=1e-6)
    assert not curves.r.any()
    assert not curves.specular_gain.any()


def test_levels_are_of_fields_and_nothing_has_none() -> None:
    np.testing.assert_allclose(field_db(np.array([1.0, 0.1j, 0.0])), [0.0, -20.0, np.nan])
    result: Any = SimpleNamespace(note="between", error_db=0.234)
    assert note_and_error(result) == "between, R within 0.23 dB"
