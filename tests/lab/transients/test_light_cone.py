"""The light-cone transform against a point scatterer by hand, its own adjoint, and a plain sum over spheres."""

from __future__ import annotations

import numpy as np
import pytest

from lab.transients.light_cone import LightCone, reconstruct
from lab.transients.shape import hidden_shape
from msgs.values.units import SPEED_OF_LIGHT_MPS
from tests.captures import DATA, needs
from tests.lab.transients.scans import BIN_S, HALF_WIDTH_M, point_scan, scan_of

CHART, SIGN = (DATA / "spad_cnlos" / f"data_{name}.mat" for name in ("dot_chart_40cm", "exit_sign"))
#: A bin stands for c 16 ps / 2 = 2.4 mm.
RANGE_BIN_M = 0.5 * SPEED_OF_LIGHT_MPS * BIN_S


@pytest.mark.parametrize(("falloff", "exponent"), [("retroreflective", 2), ("matt", 4)])
@pytest.mark.parametrize(("row", "column", "depth_m"), [(8, 8, 0.30), (11, 5, 0.30), (4, 12, 0.42)])
def test_a_point_scatterer_is_reconstructed_at_its_place(
    falloff: str, exponent: int, row: int, column: int, depth_m: float
) -> None:
    """In front of the middle of a cell: that very cell, and its depth within two bins (4.8 mm)."""
    wall_m = scan_of(np.zeros((16, 16, 256))).wall_m
    scan = point_scan((wall_m[row], wall_m[column], depth_m), exponent=exponent)
    shape = hidden_shape(reconstruct(scan, 0, falloff), scan, threshold=0.9)
    assert np.unravel_index(shape.brightness.argmax(), (16, 16)) == (row, column)
    assert abs(shape.depth_m[row, column] - depth_m) <= 2.0 * RANGE_BIN_M


def test_forward_of_a_voxel_is_its_cone() -> None:
    """Mean time of each wall point 2 r / c within a bin; counts fall with r^-2 within 2 % (bins are 1 % of r wide)."""
    scan = scan_of(np.zeros((16, 16, 256)))
    volume = np.zeros(scan.counts.shape, np.float32)
    volume[8, 8, 125] = 1.0
    seen = LightCone(scan).forward(volume).astype(np.float64)
    across_m = scan.wall_m - scan.wall_m[8]
    range_m = np.sqrt(np.square(across_m[:, None]) + np.square(across_m[None]) + scan.range_m[125] ** 2)
    total = seen.sum(axis=2)
    assert np.abs((seen * scan.range_m).sum(axis=2) / total - range_m).max() < RANGE_BIN_M
    assert total / total[8, 8] == pytest.approx((range_m[8, 8] / range_m) ** 2, rel=0.02)


def test_adjoint_is_the_transpose_of_forward() -> None:
    """<forward(v), t> = <v, adjoint(t)> for random v and t, to single precision."""
    rng = np.random.default_rng(0)
    cone = LightCone(scan_of(np.zeros((8, 8, 64))))
    volume, transients = rng.random((2, 8, 8, 64), np.float32)
    left = float(np.vdot(cone.forward(volume).astype(np.float64), transients))
    right = float(np.vdot(volume.astype(np.float64), cone.adjoint(transients)))
    assert left == pytest.approx(right, rel=1e-4)


def test_backprojection_is_largest_where_all_spheres_meet() -> None:
    """A sum over spheres by hand has its maximum in the scatterer's cell; so has the adjoint, within a bin of depth."""
    scan = point_scan((HALF_WIDTH_M / 16.0, -HALF_WIDTH_M / 16.0, 0.33))
    volume = LightCone(scan).adjoint(scan.counts)
    by_hand = np.zeros(scan.counts.shape)
    for row, column in np.ndindex(16, 16):
        across = np.square(scan.wall_m - scan.wall_m[row])[:, None] + np.square(scan.wall_m - scan.wall_m[column])[None]
        range_m = np.sqrt(across[..., None] + np.square(scan.range_m))
        at = np.minimum((range_m / RANGE_BIN_M).astype(int), scan.bins - 1)
        by_hand += scan.counts[row, column][at]
    found, wanted = (np.unravel_index(one.argmax(), one.shape) for one in (volume, by_hand))
    assert found[:2] == wanted[:2] == (8, 7)
    assert abs(int(found[2]) - int(wanted[2])) <= 1


def test_forward_then_inverse_gives_a_plane_back() -> None:
    """A square at one depth: every pixel of it within two bins, nothing brighter outside."""
    scan = scan_of(np.zeros((16, 16, 256)))
    volume = np.zeros(scan.counts.shape, np.float32)
    volume[5:11, 5:11, 130] = 1.0
    found = LightCone(scan).invert(LightCone(scan).forward(volume), snr=100.0)
    bright = found.max(axis=2)
    assert np.abs(found.argmax(axis=2)[5:11, 5:11] - 130).max() <= 2
    assert bright[5:11, 5:11].min() > 2.0 * bright[0].max()


@pytest.mark.parametrize("snr", [0.0, -1.0, np.nan, np.inf])
def test_an_snr_that_is_none_is_refused(snr: float) -> None:
    with pytest.raises(ValueError, match="snr must be finite and positive"):
        LightCone(point_scan((0.0, 0.0, 0.3))).invert(np.zeros((4, 4, 4), np.float32), snr)


def test_a_first_bin_beyond_the_last_is_refused() -> None:
    with pytest.raises(ValueError, match=r"first_bin must lie in 0\.\.255, got 256"):
        reconstruct(point_scan((0.0, 0.0, 0.3)), 256)


@needs(CHART)
def test_the_real_dot_chart_stands_at_40_cm_and_shows_nine_dots() -> None:
    """Real photons, 40 cm by its name: the distance within 2 cm, and nine separate spots in three rows."""
    from scipy.ndimage import label

    from lab.transients.confocal import read_confocal

    scan = read_confocal(CHART)
    shape = hidden_shape(reconstruct(scan, 600), scan, threshold=0.4)
    assert abs(shape.distance_m - 0.40) < 0.02
    spots, _ = label(shape.brightness > 0.4)
    sizes = np.bincount(spots.ravel())[1:]
    assert (sizes >= 10).sum() == 9


@needs(SIGN)
def test_the_real_exit_sign_is_one_plane() -> None:
    """No truth but its own: the lit pixels lie within 2 mm rms of a plane that is tilted by 6 degrees."""
    from lab.transients.confocal import read_confocal

    scan = read_confocal(SIGN)
    shape = hidden_shape(reconstruct(scan, 600), scan)
    x_m, y_m = np.meshgrid(scan.wall_m, scan.wall_m, indexing="ij")
    plane_m = shape.plane[0] + shape.plane[1] * x_m + shape.plane[2] * y_m
    off_m = (shape.depth_m - plane_m)[shape.lit]
    assert np.median(np.abs(off_m)) < 0.003
    assert 0.80 < shape.distance_m < 0.83
