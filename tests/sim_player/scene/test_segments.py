"""Legs against blockers: straight pieces against the exact crossing, arcs against fine polylines, factors by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import fresnel

from models.physics.curved_mirror import arc_points
from models.physics.fresnel import stack_transmission
from models.physics.mirror import crosses
from sim_player.scene.segments import (
    BODY,
    TABLE_STEPS,
    VOLUME,
    WALL,
    Blockers,
    Occlusion,
    free_segments,
    is_screened,
    segment_occlusion,
    without,
)


def blockers(a: np.ndarray, b: np.ndarray, **more: object) -> Blockers:
    """Tall walls that let half the field through, unless told otherwise."""
    count = len(a)
    values: dict[str, object] = {
        "height_m": np.full(count, 5.0),
        "curvature_per_m": np.zeros(count),
        "kind": np.full(count, WALL, np.int8),
        "owner": np.full(count, -1, np.int32),
        "build": np.arange(count, dtype=np.int32),
        "box": np.full(count, -1, np.int32),
        "transmission": np.full((count, TABLE_STEPS + 1), 0.5 + 0j),
    }
    return Blockers(a, b, **{**values, **more})  # type: ignore[arg-type]


def opaque(a: np.ndarray, b: np.ndarray, **more: object) -> Blockers:
    """The same of walls that let nothing through."""
    return blockers(a, b, **{"transmission": np.zeros((len(a), TABLE_STEPS + 1), np.complex128), **more})


def level(points: np.ndarray, height_m: float = 1.0) -> np.ndarray:
    return np.column_stack([points, np.full(len(points), height_m)])


def test_straight_pieces_are_those_of_the_mirror_law() -> None:
    """2000 random legs x 15 pieces, some sharing ends, some legs ending on pieces: `models.physics.mirror.crosses`."""
    rng = np.random.default_rng(1)
    corners = rng.uniform(-10.0, 10.0, (16, 2))
    a, b = corners[:-1], corners[1:]
    start, end = rng.uniform(-12.0, 12.0, (2, 2000, 2))
    share = rng.uniform(0.0, 1.0, 500)
    end[:500] = a[3] + share[:, None] * (b[3] - a[3])
    end[500:600] = corners[rng.integers(16, size=100)]
    met = crosses(start, end, a, b)
    legs = segment_occlusion(level(start), level(end), blockers(a, b))
    np.testing.assert_array_equal(legs.free, ~met.any(axis=1))
    np.testing.assert_allclose(legs.through, 0.5 ** met.sum(axis=1), rtol=1e-12)


@pytest.mark.parametrize("turn", [2e-6, 1e-3, 0.01, 0.5, 1.5, 1.99])
def test_arcs_are_fine_polylines(turn: float) -> None:
    """1000 random legs x 3 arcs: crossings of 800 chords (1e-5 m off); legs within 2e-4 m of a border left out."""
    rng = np.random.default_rng(2)
    a = rng.uniform(-6.0, 6.0, (3, 2))
    b = a + rng.uniform(3.0, 9.0, (3, 1)) * np.array([[1.0, 0.2], [-0.3, 1.0], [0.8, -0.8]])
    curvature = np.array([1.0, -1.0, 1.0]) * turn / np.hypot(*(b - a).T)
    start, end = rng.uniform(-12.0, 12.0, (2, 1000, 2))
    count, nearly = np.zeros(1000), np.zeros(1000, bool)
    for p, q, bend in zip(a, b, curvature, strict=True):
        line = arc_points(p, q, bend, np.linspace(0.0, 1.0, 801))
        cuts = [crosses(start, end, line[:-1] + shift, line[1:] + shift).sum(axis=1) for shift in (0.0, 2e-4, -2e-4)]
        nearly |= (cuts[0] != cuts[1]) | (cuts[0] != cuts[2])
        count += cuts[0]
    legs = segment_occlusion(level(start), level(end), blockers(a, b, curvature_per_m=curvature))
    assert nearly.mean() < 0.01
    np.testing.assert_allclose(legs.through[~nearly], 0.5 ** count[~nearly], rtol=1e-12)
    np.testing.assert_array_equal(legs.free[~nearly], count[~nearly] == 0)
    assert count.max() >= 2


def test_legs_that_start_on_an_arc_leave_it() -> None:
    """Points of a hollow arc see its inside; points of its outside do not see through it."""
    a, b = np.array([[0.0, -5.0]]), np.array([[0.0, 5.0]])
    bowl = blockers(a, b, curvature_per_m=np.array([0.15]))
    on = level(arc_points(a[0], b[0], 0.15, np.linspace(0.05, 0.95, 50)))
    inside = segment_occlusion(on, level(np.tile([[-2.0, 0.3]], (50, 1))), bowl)
    outside = segment_occlusion(level(np.tile([[9.0, 0.3]], (50, 1))), level(np.tile([[-2.0, 0.3]], (50, 1))), bowl)
    assert inside.free.all()
    assert not outside.free.any()


def test_heights_decide_at_the_crossing() -> None:
    """Wall 2 m high at x = 5, leg from 1 m to h at x = 10: blocked while 1 + (h - 1) / 2 < 2, so under h = 3."""
    fence = blockers(np.array([[5.0, -1.0]]), np.array([[5.0, 1.0]]), height_m=np.array([2.0]))
    height = np.array([0.0, 2.0, 2.99, 3.01, 9.0])
    end = np.column_stack([np.full(5, 10.0), np.zeros(5), height])
    assert segment_occlusion(np.array([0.0, 0.0, 1.0]), end, fence).free.tolist() == [False, False, False, True, True]


def test_foliage_multiplies_and_bodies_stop() -> None:
    """Two hedges of 0.6 and 0.7, a wall of 0.5, a body of 0: products by kind; only wall and body block."""
    x = np.array([1.0, 2.0, 3.0, 4.0])
    a, b = np.column_stack([x, np.full(4, -1.0)]), np.column_stack([x, np.full(4, 1.0)])
    passing = np.array([0.6, 0.7, 0.5, 0.0])[:, None] * np.ones(TABLE_STEPS + 1) + 0j
    things = blockers(a, b, kind=np.array([VOLUME, VOLUME, WALL, BODY], np.int8), transmission=passing)
    end = level(np.array([[0.5, 0.0], [1.5, 0.0], [2.5, 0.0], [3.5, 0.0], [4.5, 0.0]]))
    legs = segment_occlusion(np.array([0.0, 0.0, 1.0]), end, things)
    assert legs.free.tolist() == [True, True, True, False, False]
    np.testing.assert_allclose(legs.foliage, [1.0, 0.6, 0.42, 0.42, 0.42], rtol=1e-12)
    np.testing.assert_allclose(legs.through, [1.0, 1.0, 1.0, 0.5, 0.0], rtol=1e-12)


@pytest.mark.parametrize("curvature_per_m", [0.0, 0.05, -0.05])
def test_what_passes_goes_by_the_angle_in_space(curvature_per_m: float) -> None:
    """A factor that is the cosine itself: a leg that rises by 6 m over 8 m meets what stands across it at 0.8."""
    pane = blockers(
        np.array([[4.0, -1.0]]), np.array([[4.0, 1.0]]), curvature_per_m=np.array([curvature_per_m]),
        transmission=np.linspace(0.0, 1.0, TABLE_STEPS + 1)[None] + 0j,
    )  # fmt: skip
    legs = segment_occlusion(np.array([0.0, 0.0, 1.0]), np.array([[8.0, 0.0, 7.0]]), pane)
    np.testing.assert_allclose(legs.through, [0.8], rtol=1e-9)


def test_own_bodies_do_not_count() -> None:
    """A leg to a thing's own point passes that thing's sides, and no other's; in a chain the last leg alone."""
    a, b = np.array([[2.0, -1.0], [4.0, -1.0]]), np.array([[2.0, 1.0], [4.0, 1.0]])
    things = blockers(a, b, owner=np.array([0, 1], np.int32))
    end = level(np.array([[3.0, 0.0], [3.0, 0.0], [5.0, 0.0]]))
    owner = np.array([0, 1, 1], np.int32)
    assert segment_occlusion(np.array([0.0, 0.0, 1.0]), end, things, owner).free.tolist() == [True, False, False]
    chain = free_segments((np.array([0.0, 0.0, 1.0]), level(np.tile([[3.0, 0.5]], (3, 1))), end), things, owner)
    assert chain.free.tolist() == [False, False, False]


def test_chains_are_legs_in_series() -> None:
    """Free chains: as their legs taken one by one, foliage included; others are 0 through."""
    rng = np.random.default_rng(4)
    a, b = rng.uniform(-9.0, 9.0, (2, 8, 2))
    kind = np.array([VOLUME] * 5 + [WALL] * 3, np.int8)
    things = blockers(a, b, kind=kind)
    points = rng.uniform(-9.0, 9.0, (3, 400, 2))
    one, two, three = (level(place) for place in points)
    chain = free_segments((one, two, three), things)
    first, last = segment_occlusion(one, two, things), segment_occlusion(two, three, things)
    np.testing.assert_array_equal(chain.free, first.free & last.free)
    np.testing.assert_allclose(chain.foliage[chain.free], (first.foliage * last.foliage)[chain.free], rtol=1e-12)
    assert 50 < chain.free.sum() < 350
    assert (chain.through[~chain.free] == 0.0).all()


def test_left_out_pieces_do_not_block() -> None:
    a, b = np.array([[2.0, -1.0], [4.0, -1.0]]), np.array([[2.0, 1.0], [4.0, 1.0]])
    end = level(np.array([[3.0, 0.0], [5.0, 0.0]]))
    assert segment_occlusion(np.array([0.0, 0.0, 1.0]), end, without(blockers(a, b), 0)).free.tolist() == [True, False]


@pytest.mark.parametrize("thickness_m", [6e-3, 0.3])
def test_the_table_of_what_passes(thickness_m: float) -> None:
    """Linear steps h = 1/1024 in the cosine, low-loss pane and wall, 30 deg of grazing and more: h^2/8 max |f''|.

    The second derivative by differences; 5 % for its rounding. In all below 1e-4 of the field.
    """

    def factor(cosine: np.ndarray) -> np.ndarray:
        t = stack_transmission([6.3 - 0.1j], [thickness_m], cosine, 0.03)
        return np.asarray(t * np.exp(2j * math.pi / 0.03 * thickness_m * cosine))

    table = factor(np.linspace(0.0, 1.0, TABLE_STEPS + 1))[None]
    cosine = np.random.default_rng(5).uniform(0.5, 1.0, 2000)
    read = np.interp(cosine, np.linspace(0.0, 1.0, TABLE_STEPS + 1), table[0])
    error = np.abs(read - factor(cosine))
    fine = np.linspace(0.5, 1.0, 20001)
    bend = np.abs(np.diff(factor(fine), 2)).max() / (fine[1] - fine[0]) ** 2
    assert error.max() < 1.05 * bend / 8.0 / TABLE_STEPS**2
    assert error.max() < 1e-4
    # and the compiled legs read the same table
    pane = blockers(np.array([[1.0, -99.0]]), np.array([[1.0, 99.0]]), transmission=table)
    end = level(np.column_stack([2.0 * cosine, 2.0 * np.sqrt(1.0 - cosine**2)]))
    met = end[:, 0] > 1.0001
    legs = segment_occlusion(np.array([0.0, 0.0, 1.0]), end, pane)
    np.testing.assert_allclose(legs.through[met], read[met], rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_boxes_change_nothing_but_the_order(seed: int) -> None:
    """400 pieces of all kinds, 3,000 legs: by boxes as one by one. Three pieces lie on one another, one has no length
    seen from a leg along it, legs begin and end on pieces, run along axes, and have no length. Products of factors are
    multiplied in another order: 1e-12.
    """
    rng = np.random.default_rng(seed)
    a = rng.uniform(-60.0, 60.0, (400, 2))
    b = a + rng.normal(0.0, 6.0, (400, 2))
    a[1:3], b[1:3] = a[0], b[0]
    curvature = np.where(rng.random(400) < 0.3, rng.uniform(-1.0, 1.0, 400) / np.hypot(*(b - a).T), 0.0)
    many = blockers(
        a,
        b,
        height_m=rng.uniform(0.5, 5.0, 400),
        curvature_per_m=curvature,
        kind=rng.choice([BODY, WALL, VOLUME, VOLUME], 400).astype(np.int8),
        owner=rng.integers(-1, 5, 400).astype(np.int32),
        build=rng.integers(0, 3, 400).astype(np.int32),
        transmission=np.array([0.9 + 0.1j, 0.5 + 0.0j, 0.0j])[:, None] * np.ones(TABLE_STEPS + 1),
    )
    start, end = level(rng.uniform(-60.0, 60.0, (3000, 2))), level(rng.uniform(-60.0, 60.0, (3000, 2)), 2.0)
    start[:200, :2], end[200:400, :2] = b[rng.integers(0, 400, 200)], a[rng.integers(0, 400, 200)]
    start[400:402, :2], end[400:402, :2] = a[0] - (b[0] - a[0]), b[0] + (b[0] - a[0])
    end[500:600, 0], end[600:700, 1] = start[500:600, 0], start[600:700, 1]
    end[700:710] = start[700:710]
    owner = rng.integers(-1, 5, 3000).astype(np.int32)
    all_of_them = segment_occlusion(start, end, many, owner)
    boxed = segment_occlusion(start, end, replace(many, tree=True), owner)
    np.testing.assert_array_equal(boxed.free, all_of_them.free)
    np.testing.assert_allclose(boxed.through, all_of_them.through, rtol=1e-12)
    np.testing.assert_array_equal(boxed.through == 0.0, all_of_them.through == 0.0)
    passed = all_of_them.through != 0.0
    np.testing.assert_allclose(boxed.foliage[passed], all_of_them.foliage[passed], rtol=1e-12)
    assert 300 < all_of_them.free.sum() < 2500
    assert (passed & ~all_of_them.free).sum() > 100


@pytest.mark.parametrize("count", [0, 1, 4, 5, 1000])
def test_every_piece_stands_in_one_box(count: int) -> None:
    """However many pieces, and all of them in one spot: a leg across meets each once."""
    a, b = np.tile([[5.0, -1.0]], (count, 1)), np.tile([[5.0, 1.0]], (count, 1))
    glass = replace(blockers(a, b, kind=np.full(count, VOLUME, np.int8)), tree=True)
    factor = 1.0 - 1e-3
    glass = replace(glass, transmission=np.full((max(count, 1), TABLE_STEPS + 1), factor + 0j))
    legs = segment_occlusion(np.array([0.0, 0.0, 1.0]), level(np.array([[9.0, 0.0], [4.0, 0.0]])), glass)
    np.testing.assert_allclose(legs.foliage, [factor**count, 1.0], rtol=1e-12)


@pytest.mark.parametrize("before_line", [True, False])
def test_a_screened_bundle_has_no_free_ray(before_line: bool) -> None:
    """3000 bundles over a line, before or behind it one wall: where it screens them, each of 60 rays is blocked.

    It does so for two of five, at least, whose 60 rays are all blocked: not where the wall itself crosses the line.
    """
    rng = np.random.default_rng(4)
    screened, blocked = 0, 0
    for _ in range(3000):
        source, place = np.array([rng.uniform(-4, 4), 6.0]), np.array([rng.uniform(-4, 4), -6.0])
        radius, turn = rng.uniform(0.05, 1.5), rng.uniform(0.0, 2.0 * np.pi, 60)
        line = (0.0, 1.0, 0.0) if before_line else (0.0, -1.0, 0.0)
        walls = opaque(*rng.uniform(-9.0, 9.0, (2, 1, 2)))
        points = place + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        middle = 0.5 * (source + place)
        cuts = source + (points - source) * (source[1] / (source[1] - points[:, 1]))[:, None]
        ends = (np.tile(source, (60, 1)), cuts) if before_line else (cuts, points)
        free = segment_occlusion(level(ends[0], 2.0), level(ends[1], 2.0), walls).free
        between = (source, middle) if before_line else (middle, place)
        pairs = tuple(tuple(end.tolist()) for end in between)
        found = is_screened(tuple(source.tolist()), (*place.tolist(), radius), pairs, 2.0, line, walls.pieces)
        assert not (found and free.any())
        screened, blocked = screened + found, blocked + (not free.any())
    assert 50 < 0.4 * blocked < screened <= blocked


def test_a_screen_must_be_wide_high_and_a_wall() -> None:
    """Circle of radius 1 at 10 m, wall at 4 m: tangents meet it at 4 tan(asin(0.1)) to either side."""
    half = 4.0 * math.tan(math.asin(0.1))

    def screens(left: float, right: float, top: float = 2.0, **more: object) -> bool:
        walls = opaque(np.array([[-left, 4.0]]), np.array([[right, 4.0]]), **more)
        return bool(
            is_screened((0.0, 0.0), (0.0, 10.0, 1.0), ((0.0, 0.0), (0.0, 6.0)), top, (0.0, -1.0, 6.0), walls.pieces)
        )

    wide = half + 0.01
    assert screens(wide, wide)
    assert not screens(half - 0.01, wide)
    assert not screens(wide, half - 0.01)
    assert not screens(wide, wide, top=5.0)
    # what passes over a top of 3 m more: Fresnel's argument at the middle of a ray of 13 m, 3 sqrt(8 / (13 lambda))
    assert screens(wide, wide, wavelength_m=0.98 * (3.0 / 5.0) ** 2 * 8.0 / 13.0)
    assert not screens(wide, wide, wavelength_m=1.02 * (3.0 / 5.0) ** 2 * 8.0 / 13.0)
    pane = np.full((1, TABLE_STEPS + 1), 0.02 + 0j)
    assert not screens(wide, wide, transmission=pane)
    assert screens(wide, wide, transmission=0.99 * pane)
    assert not screens(wide, wide, kind=np.array([VOLUME], np.int8))
    assert not screens(wide, wide, kind=np.array([BODY], np.int8), owner=np.array([3], np.int32))
    assert not screens(wide, wide, curvature_per_m=np.array([0.5]))


def fresnel_share(v: np.ndarray) -> np.ndarray:
    """Share of a wave that passes a knife edge, ITU-R P.526-15 Eq. (29), by scipy's Fresnel integrals."""
    sine, cosine = fresnel(v)
    return np.asarray(0.5 * (1.0 + 1j) * ((0.5 + cosine) - 1j * (0.5 + sine)))


@pytest.mark.parametrize("end_m", [0.6, 1.0, 2.4])
def test_a_top_is_a_knife_edge(end_m: float) -> None:
    """Legs of 20 m from 1 m up over walls 7 m away: Fresnel's share of v, with T of what the wall lets through.

    To 1e-9 within |v| < 3, where nothing fades; 1 and 0 from 6 on; nowhere a step: 1e-7 m change less than 1e-6.
    """
    wavelength_m, span = 0.03, np.hypot(20.0, end_m - 1.0)
    ray_m = 1.0 + 0.35 * (end_m - 1.0)
    unit_m = math.sqrt(0.5 * wavelength_m * span * 0.35 * 0.65)
    v = np.concatenate([np.linspace(-2.99, 2.99, 41), [-6.1, 6.1], np.linspace(-6.5, 6.5, 500)])
    legs = [_over_one(ray_m - v * unit_m + raised, end_m, wavelength_m) for raised in (0.0, 1e-7)]
    np.testing.assert_allclose(legs[0].over[:41], fresnel_share(v[:41]), atol=1e-9)
    np.testing.assert_allclose(legs[0].through[:41], 0.5 + 0.5 * fresnel_share(v[:41]), atol=1e-9)
    assert legs[0].over[41:43].tolist() == [0.0, 1.0]
    assert np.abs(legs[1].over - legs[0].over).max() < 1e-6
    # by rays alone
    sharp = _over_one(ray_m - v * unit_m, end_m, 0.0)
    assert set(np.abs(sharp.over).tolist()) == {0.0, 1.0}


def _over_one(height_m: np.ndarray, end_m: float, wavelength_m: float) -> Occlusion:
    """A leg over one wall of each height."""
    a, b = np.array([[7.0, -9.0]]), np.array([[7.0, 9.0]])
    start, end = np.array([0.0, 0.0, 1.0]), np.array([[20.0, 0.0, end_m]])
    legs = [
        segment_occlusion(start, end, blockers(a, b, height_m=np.array([h]), wavelength_m=wavelength_m))
        for h in height_m
    ]
    columns = ((leg.free, leg.over, leg.through, leg.foliage) for leg in legs)
    return Occlusion(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def test_tops_of_walls_multiply_and_a_box_counts_once() -> None:
    """Two walls, a body of four faces met on two sides, foliage: each its own share, the body the least of its two."""
    corners = np.array([[4.0, -1.0], [8.0, -1.0], [8.0, 1.0], [4.0, 1.0]])
    walls = np.array([[12.0, -9.0], [15.0, -9.0]])
    a, b = np.concatenate([corners, walls]), np.concatenate([np.roll(corners, -1, axis=0), walls * [1.0, -1.0]])
    height = np.array([0.95] * 4 + [1.05, 0.9])
    every = blockers(
        a,
        b,
        height_m=height,
        kind=np.array([BODY] * 4 + [WALL, VOLUME], np.int8),
        box=np.array([0] * 4 + [-1, -1], np.int32),
        transmission=np.array([0.0] * 4 + [0.3j, 0.6])[:, None] * np.ones(TABLE_STEPS + 1),
        wavelength_m=0.03,
    )
    at = np.array([8.0, 12.0, 15.0])
    v = (1.0 - height[[0, 4, 5]]) * np.sqrt(2.0 * 20.0 / (0.03 * at * (20.0 - at)))
    body, metal, leaves = fresnel_share(v)
    start, end = np.array([0.0, 0.0, 1.0]), np.array([[20.0, 0.0, 1.0]])
    for tree in (False, True):
        legs = segment_occlusion(start, end, replace(every, tree=tree))
        # the body's second side, 8 m away, is nearer to the middle: a ray over it has the lesser v
        np.testing.assert_allclose(legs.over, body * metal, rtol=1e-9)
        np.testing.assert_allclose(legs.through, body * (0.3j + (1.0 - 0.3j) * metal), rtol=1e-9)
        np.testing.assert_allclose(legs.foliage, abs(0.6 + 0.4 * leaves), rtol=1e-9)
