"""Hard cases of the diffuse lobe: grazing, no and huge heights, correlation lengths far from the wavelength."""

from __future__ import annotations

import math

import numpy as np
import pytest

from models.physics.rough_lobe import RoughLobe, mean_over_orders
from sim_player.scene.description import Scene, Surface
from sim_player.scene.world import prepare
from tests.sim_player.trace.point_scenes import points_world, traced, wall
from tests.stability.catalogue import Errors

WAVELENGTH_M = 299_792_458.0 / 10e9
HEIGHTS_M = (1e-200, 1e-12, 1e-6, 1e-3, 0.03, 1.0, 10.0)
CORRELATIONS_M = (1e-300, 1e-9, 1e-4, 0.03, 1.0, 10.0)
COSINES = np.concatenate([[0.0, 1e-300, 1e-12, 1e-6], np.linspace(1e-3, 1.0, 40)])


@pytest.mark.parametrize("roughness_m", HEIGHTS_M)
@pytest.mark.parametrize("correlation_m", CORRELATIONS_M)
def test_lobe_is_finite_for_every_wall_and_angle(roughness_m: float, correlation_m: float) -> None:
    """10 m is the largest height and length that a scene may state; no overflow, no division by nothing."""
    lobe = RoughLobe(roughness_m, correlation_m, WAVELENGTH_M)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        back = lobe.backscatter(COSINES, 0.15)
    assert np.all(np.isfinite(back) & (back >= 0.0))


@pytest.mark.parametrize("correlation_m", CORRELATIONS_M)
def test_lobe_vanishes_with_the_height(correlation_m: float) -> None:
    """Power goes as height squared: 1e-9 m and 1e-8 m differ by a hundred, and nothing is left at 1e-200 m."""
    small, ten_times, none = (
        RoughLobe(s, correlation_m, WAVELENGTH_M).backscatter([1.0]) for s in (1e-9, 1e-8, 1e-200)
    )
    assert none == 0.0
    if correlation_m > 1e-7:
        assert ten_times / small == pytest.approx(100.0, rel=1e-6)


@pytest.mark.parametrize("roughness_m", [1e-3, 0.03, 10.0])
@pytest.mark.parametrize("correlation_m", [1e-9, 1e-3, 0.03, 0.3])
def test_nothing_comes_back_at_grazing(roughness_m: float, correlation_m: float) -> None:
    """Every wall is smooth at grazing, or its facets are turned away: below Lambert's lobe of all power, 4 cos^2."""
    cosine = np.array([1e-3, 3e-3, 1e-2])
    back = RoughLobe(roughness_m, correlation_m, WAVELENGTH_M).backscatter(cosine)
    assert np.all(back <= 4.0 * cosine**2)


@pytest.mark.parametrize("roughness_m", [0.3, 3.0, 10.0])
def test_huge_heights_all_look_alike(roughness_m: float) -> None:
    """Facets have no wavelength: walls of one slope have one lobe; 1 % (orders spread by 1 / 2 k s)."""
    cosine = np.cos(np.radians([0.0, 10.0, 20.0, 30.0]))
    slope = 0.3
    lobes = [
        RoughLobe(height_m, math.sqrt(2.0) * height_m / slope, WAVELENGTH_M).backscatter(cosine)
        for height_m in (roughness_m, 1e3)
    ]
    np.testing.assert_allclose(*lobes, rtol=1e-2)


def test_long_correlations_scatter_about_the_mirror_alone() -> None:
    """Heights that stay alike over 10 m: all within a milliradian of the mirror, nothing back at 10 deg."""
    lobe = RoughLobe(1e-3, 10.0, WAVELENGTH_M)
    assert lobe.backscatter(np.cos(np.radians([10.0]))) == 0.0
    assert lobe.backscatter([1.0])[0] > 1e4


def test_steeper_walls_than_facets_allow_are_those_of_slope_one() -> None:
    steep, limit = (RoughLobe(2e-3, length_m, WAVELENGTH_M) for length_m in (1e-9, math.sqrt(2.0) * 2e-3))
    np.testing.assert_array_equal(steep.backscatter(COSINES), limit.backscatter(COSINES))


@pytest.mark.hard("models.physics.rough_lobe", "g^2m exp(-g^2) / m! summed term by term", 1e-11, "",
                  "next order, 2 / g^4")  # fmt: skip
def test_orders_of_a_rough_wall(errors: Errors) -> None:
    """2 m of height, g^2 = 7e5 at 10 GHz: powers overflow, exp(-g^2) is 0. Mean of 1 / m against 1 / g^2 + 1 / g^4."""
    mean = (4.0 * math.pi * 2.0 / WAVELENGTH_M) ** 2
    exact = 1.0 / mean + 1.0 / mean**2
    with np.errstate(all="ignore"):
        terms = np.arange(1.0, 200.0)
        naive = float(np.sum(np.exp(-mean) * np.cumprod(mean / terms) / terms))
    errors(naive=naive / exact - 1.0, ours=mean_over_orders(mean, 1.0, 0.0, 0.0) / exact - 1.0)


@pytest.mark.parametrize("field", ["roughness_mm", "correlation_mm"])
def test_scene_with_nan_is_refused(field: str) -> None:
    ends = ((10.0, -5.0), (10.0, 5.0))
    surface = Surface(role="relay", material="brick", polyline_m=ends, **{field: math.nan})
    with pytest.raises(ValueError, match=rf"surfaces\[0\]\.{field}: must be finite, got nan"):
        prepare(Scene(name="nan", surfaces=(surface,)))


def test_grazing_wall_echoes_are_finite() -> None:
    """A wall that the radar sees edge-on, 0.2 m beside it, over 60 m."""
    grazing = wall((0.5, 0.2), (60.0, 0.2), material="brick", roughness_mm=4.0)
    echoes = traced(points_world([(-5.0, -300.0, 1.0)], grazing), "diffuse_scattering").echoes["diffuse_scattering"]
    assert len(echoes) > 100
    assert np.isfinite(echoes.weight).all()
