"""Hard cases of mirror geometry: parallel rays, end points, far walls, tiny walls, arcs and their caustics."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from mpmath import mp, mpf
from scipy.special import wofz

from models.physics.curved_mirror import CAUSTIC, arc_points, bounces
from models.physics.diffraction import wedge_terms_at
from models.physics.mirror import crosses, crossing_parameters, reflect, specular_points, wall_from_ends
from models.physics.plane import segment_distance_m
from sim_player.effects import los_surfaces
from sim_player.scene.description import Scene, Surface
from sim_player.scene.world import prepare, snapshot
from tests.models.physics.curved_reference import arc_crosses, focusing, one_way_field
from tests.stability.catalogue import Errors

WAVELENGTH_M = 299_792_458.0 / 10e9


def wall(*ends: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    return np.array([ends[0]]), np.array([ends[1]])


def test_ray_along_a_wall_is_not_cut() -> None:
    """Parallel and collinear rays give NaN parameters, never a division warning, and see the wall's edge."""
    a, b = wall((2.0, 0.0), (8.0, 0.0))
    targets = np.array([[10.0, 0.0], [5.0, 0.0], [10.0, 1e-300]])
    assert np.isnan(crossing_parameters(np.zeros(2), targets, a, b)[0]).all()
    assert not crosses(np.zeros(2), targets, a, b).any()


def test_target_at_the_origin_is_not_cut() -> None:
    a, b = wall((0.0, -1.0), (0.0, 1.0))
    assert not crosses(np.zeros(2), np.zeros((1, 2)), a, b).any()


def random_walls(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Walls of a street, none shorter than a metre; [count, 2] each."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-40.0, 40.0, (2, 2 * count, 2))
    long = np.hypot(*(b - a).T) > 1.0
    return a[long][:count], b[long][:count]


def naive_crosses(origin: np.ndarray, target: np.ndarray, a: np.ndarray, b: np.ndarray) -> bool:
    """Two parameters by Cramer's rule, both within 0..1; infinite or NaN where the determinant is zero."""
    (rx, ry), (wx, wy), (dx, dy) = target - origin, b - a, a - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.float64(rx * wy - ry * wx)
        along_ray, along_wall = (dx * wy - dy * wx) / turn, (dx * ry - dy * rx) / turn
    return bool((along_ray > 0.0) & (along_ray < 1.0) & (along_wall >= 0.0) & (along_wall <= 1.0))


@pytest.mark.hard("models.physics.mirror", "both parameters of the crossing within 0..1", 0.0, "of 10,000 points",
                  "a wall does not hide what stands on it")  # fmt: skip
def test_object_on_the_wall_plane_is_not_hidden(errors: Errors) -> None:
    """Points on random walls: rounding puts half of them behind."""
    rng = np.random.default_rng(5)
    a, b = rng.uniform(-40.0, 40.0, (2, 100, 2))
    points = a[:, None] + rng.uniform(0.05, 0.95, (100, 100, 1)) * (b - a)[:, None]
    hidden, naively = 0, 0
    for wall_a, wall_b, on in zip(a, b, points, strict=True):
        hidden += int(crosses(np.zeros(2), on, wall_a[None], wall_b[None]).sum())
        naively += sum(naive_crosses(np.zeros(2), point, wall_a, wall_b) for point in on)
    errors(naive=naively, ours=hidden)


@pytest.mark.hard("models.physics.mirror", "both parameters of the crossing within 0..1, in the frame of the map", 0.0,
                  "of 5,000 points", "a wall does not hide what stands on it, listed twice or not")  # fmt: skip
def test_duplicate_walls_do_not_hide_what_each_mirrors(errors: Errors) -> None:
    """The same wall twice, once by way of another frame: a rounding apart, one stands before the other's points."""
    a, b = random_walls(7, 100)
    angle = 1.1
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    twin_a, twin_b = (a @ turn + [500.0, 900.0] - [500.0, 900.0]) @ turn.T, (b @ turn + 700.0 - 700.0) @ turn.T
    share = np.random.default_rng(8).uniform(0.05, 0.95, (100, 50, 1))
    points = a[:, None] + share * (b - a)[:, None]
    hidden, naively = 0, 0
    for walls, on in zip(np.stack([a, b, twin_a, twin_b], axis=1), points, strict=True):
        hidden += int(crosses(np.zeros(2), on, walls[[0, 2]], walls[[1, 3]]).any(axis=1).sum())
        naively += sum(naive_crosses(np.zeros(2), point, walls[2], walls[3]) for point in on)
    errors(naive=naively, ours=hidden)


@pytest.mark.hard("models.physics.mirror", "both parameters of the crossing within 0..1", 0.0,
                  "of 2,000 rays that slip through", "two walls that share a corner are closed")  # fmt: skip
def test_two_walls_that_share_a_corner_leave_no_gap(errors: Errors) -> None:
    """Rays aimed at the shared corner, from every side: by rounding they pass beyond the end of either wall."""
    rng = np.random.default_rng(6)
    slipped, naively = 0, 0
    for _ in range(2000):
        corner = rng.uniform(5.0, 30.0, 2)
        ends = corner + rng.uniform(-9.0, 9.0, (2, 2))
        beyond = corner * rng.uniform(1.5, 3.0)
        a, b = np.array([ends[0], corner]), np.array([corner, ends[1]])
        slipped += not crosses(np.zeros(2), beyond[None], a, b).any()
        naively += not any(naive_crosses(np.zeros(2), beyond, *ends_of) for ends_of in zip(a, b, strict=True))
    errors(naive=naively, ours=slipped)


@pytest.mark.hard("models.physics.mirror", "both parameters of the crossing within 0..1", 0.0, "of 2,000 rays cut",
                  "a ray along a wall sees its edge, of no width")  # fmt: skip
def test_ray_parallel_to_its_wall_is_not_cut(errors: Errors) -> None:
    """Radar and object on the wall's own line, beyond its ends: the determinant is rounding, any answer comes out."""
    a, b = random_walls(9, 2000)
    rng = np.random.default_rng(10)
    before, behind = rng.uniform(0.1, 1.0, (2, 2000, 1))
    origins, targets = a - before * (b - a), b + behind * (b - a)
    cut, naively = 0, 0
    for origin, target, wall_a, wall_b in zip(origins, targets, a, b, strict=True):
        cut += int(crosses(origin, target[None], wall_a[None], wall_b[None]).sum())
        naively += naive_crosses(origin, target, wall_a, wall_b)
    errors(naive=naively, ours=cut)


@pytest.mark.hard("models.physics.mirror", "both ends weighted by their heights above the wall", 0.0,
                  "of 2,000 bounces", "nothing is mirrored by a wall seen edge-on")  # fmt: skip
def test_radar_and_object_on_the_wall_plane_have_no_mirror(errors: Errors) -> None:
    """Heights of radar and object above the wall are rounding: their ratio puts a specular point anywhere."""
    a, b = random_walls(11, 2000)
    rng = np.random.default_rng(12)
    start, end = rng.uniform(0.05, 0.45, (2, 2000, 1))
    origins, targets = a + start * (b - a), b - end * (b - a)
    seen, naively = 0, 0
    for origin, target, wall_a, wall_b in zip(origins, targets, a, b, strict=True):
        seen += int(np.isfinite(specular_points(origin, target[None], wall_a, wall_b)).all())
        normal, offset_m = wall_from_ends(wall_a, wall_b, origin)
        h1, h2 = origin @ normal + offset_m, target @ normal + offset_m
        with np.errstate(invalid="ignore", divide="ignore"):
            point = (h2 * origin + h1 * target) / (h1 + h2)
        naively += int(h1 >= 0.0 and h2 >= 0.0 and not np.isnan(point).any())
    errors(naive=naively, ours=seen)


@pytest.mark.hard("models.physics.mirror", "normal as the unit vector to the foot of the perpendicular", 2e-14, "m",
                  "rounding of 30 m in float64, four times")  # fmt: skip
def test_wall_through_the_origin(errors: Errors) -> None:
    """Walls through the radar's own place: the perpendicular from there has no length and no direction."""
    target = np.array([12.0, -3.0])
    naive, ours = [], []
    for direction in ((1.0, 0.0), (0.3, 0.7), (-1.0, 1.0), (0.1, -2.3)):
        along = np.array(direction)
        a, b = -10.0 * along, 13.0 * along
        x, y, dx, dy = (Fraction(float(value)) for value in (*target, *along))
        share = 2 * (x * dx + y * dy) / (dx * dx + dy * dy)
        exact = np.array([float(share * dx - x), float(share * dy - y)])
        foot = a - (a @ along) / (along @ along) * along
        with np.errstate(invalid="ignore", divide="ignore"):
            normal = foot / np.hypot(*foot)
        naive.append(target - 2.0 * (normal @ target - np.hypot(*foot)) * normal - exact)
        ours.append(reflect(target, *wall_from_ends(a, b, target)) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.mirror", "mirror in y = m x + q", 2e-14, "m",
                  "rounding of 30 m in float64, four times")  # fmt: skip
def test_wall_straight_ahead_has_no_slope(errors: Errors) -> None:
    """Walls along y, exactly and by 1e-9 m: the slope is infinite or 3e10, and q with it."""
    target = np.array([12.0, -3.0])
    naive, ours = [], []
    for lean_m in (0.0, 1e-9, 0.3):
        a, b = np.array([5.0, -10.0]), np.array([5.0 + lean_m, 20.0])
        ax, ay, bx, by, x, y = (Fraction(float(value)) for value in (*a, *b, *target))
        dx, dy = bx - ax, by - ay
        share = 2 * ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)
        exact = np.array([float(2 * ax + share * dx - x), float(2 * ay + share * dy - y)])
        with np.errstate(invalid="ignore", divide="ignore"):
            m = np.float64(b[1] - a[1]) / (b[0] - a[0])
            q = a[1] - m * a[0]
            d = (target[0] + (target[1] - q) * m) / (1.0 + m * m)
            naive.append(np.array([2.0 * d - target[0], 2.0 * d * m - target[1] + 2.0 * q]) - exact)
        ours.append(reflect(target, *wall_from_ends(a, b, target)) - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.mirror", "foot of the perpendicular over the squared length", 1e-14, "m",
                  "rounding of 10 m in float64, four times")  # fmt: skip
def test_zero_length_wall(errors: Errors) -> None:
    """A wall whose ends are one point has a distance all the same, cuts nothing and is refused as a mirror."""
    end, points = np.array([[3.0, 4.0]]), np.array([[0.0, 0.0], [3.0, 4.0], [9.0, 12.0]])
    exact = np.array([5.0, 0.0, 10.0])
    with np.errstate(invalid="ignore"):
        share = np.sum((points - end) * (end - end), axis=1) / np.sum((end - end) ** 2, axis=1)
    naive = np.hypot(*(points - end - share[:, None] * (end - end)).T)
    assert not crosses(np.zeros(2), 2.0 * points, end, end).any()
    with pytest.raises(ValueError, match="wall must be longer"):
        wall_from_ends(end[0], end[0], np.zeros(2))
    errors(naive=np.abs(naive - exact).max(), ours=np.abs(segment_distance_m(points, end, end)[:, 0] - exact).max())


def exact_share(origin: np.ndarray, target: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Where a ray meets a wall's line, along the ray, in rational numbers."""
    ox, oy, tx, ty, ax, ay, bx, by = (Fraction(float(value)) for value in (*origin, *target, *a, *b))
    wx, wy = bx - ax, by - ay
    return float(((ax - ox) * wy - (ay - oy) * wx) / ((tx - ox) * wy - (ty - oy) * wx))


def lines_meet(p1: np.ndarray, p2: np.ndarray, p3: np.ndarray, p4: np.ndarray) -> np.ndarray:
    """The textbook point of two lines, with the determinants x1 y2 - y1 x2."""
    (x1, y1), (x2, y2), (x3, y3), (x4, y4) = p1, p2, p3, p4
    turn = (x1 - x2) * (y3 - y4) - (y1 - y2) * (x3 - x4)
    one, two = x1 * y2 - y1 * x2, x3 * y4 - y3 * x4
    return np.array([one * (x3 - x4) - (x1 - x2) * two, one * (y3 - y4) - (y1 - y2) * two]) / turn


@pytest.mark.hard("models.physics.mirror", "point of two lines by the determinants x1 y2 - y1 x2", 5e-13, "m",
                  "four roundings (1e-16 each) of 110 m over the sine between ray and wall, 0.1 and more")  # fmt: skip
def test_huge_scene_in_map_coordinates(errors: Errors) -> None:
    """A street in metres of a national grid, 5,000 km from its origin: products of 2e13 m^2 end on 4e-3."""
    rng = np.random.default_rng(13)
    place = np.array([4.6e5, 5.4e6])
    naive, ours = [], []
    while len(ours) < 200:
        origin, target, a, b = place + rng.uniform(-40.0, 40.0, (4, 2))
        ray, along = target - origin, b - a
        sine = (ray[0] * along[1] - ray[1] * along[0]) / (np.hypot(*ray) * np.hypot(*along))
        share = exact_share(origin, target, a, b)
        if abs(sine) < 0.1 or not 0.0 < share < 1.0:
            continue
        exact = share * ray
        naive.append(lines_meet(origin, target, a, b) - origin - exact)
        ours.append(crossing_parameters(origin, target[None], a[None], b[None])[0][0, 0] * ray - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.mirror", "lines are parallel where the determinant is below 1e-9 m^2", 1e-13,
                  "of the ray", "rounding, over the sine of 0.01")  # fmt: skip
def test_tiny_scene(errors: Errors) -> None:
    """Rays and walls of 10 um (a street in megametres is no different): a fixed threshold takes all as parallel."""
    rng = np.random.default_rng(14)
    naive, ours = [], []
    while len(ours) < 200:
        origin, target, a, b = 1e-5 * rng.uniform(-1.0, 1.0, (4, 2))
        (rx, ry), (wx, wy), (dx, dy) = target - origin, b - a, a - origin
        turn, share = rx * wy - ry * wx, exact_share(origin, target, a, b)
        if abs(turn) < 0.01 * np.hypot(rx, ry) * np.hypot(wx, wy) or not 0.0 < share < 1.0:
            continue
        naive.append((np.nan if abs(turn) < 1e-9 else (dx * wy - dy * wx) / turn) - share)
        ours.append(crossing_parameters(origin, target[None], a[None], b[None])[0][0, 0] - share)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.parametrize("far_m", [1e3, 1e6])
def test_reflection_far_from_the_origin_keeps_its_precision(far_m: float) -> None:
    """Twice reflected is where it was, to the rounding of the coordinates' own size."""
    points = np.array([[far_m + 1.0, -far_m + 2.0]])
    normal, offset = wall_from_ends([far_m, -far_m], [far_m + 3.0, -far_m + 4.0], [0.0, 0.0])
    twice = reflect(reflect(points, normal, offset), normal, offset)
    np.testing.assert_allclose(twice, points, atol=4.0 * np.spacing(2.0 * far_m))


def test_grazing_mirror_paths_stay_on_the_wall() -> None:
    """Radar and target 1 um off a 60 m wall: the specular point lies on it, between both."""
    targets = np.array([[50.0, 1e-6]])
    point = specular_points(np.array([0.0, 1e-6]), targets, np.array([-5.0, 0.0]), np.array([55.0, 0.0]))
    np.testing.assert_allclose(point, [[25.0, 0.0]], atol=1e-9)


def test_shortest_walls_are_refused_and_the_next_are_not() -> None:
    with pytest.raises(ValueError, match="wall must be longer"):
        wall_from_ends([5.0, 5.0], [5.0, 5.0 + 1e-7], [0.0, 0.0])
    normal, _ = wall_from_ends([5.0, 5.0], [5.0, 5.0 + 2e-6], [0.0, 0.0])
    np.testing.assert_allclose(normal, [-1.0, 0.0])


#: Nearly a half circle of 20 m radius around (0, 0), hollow to the left of a -> b (which runs upwards).
HOLLOW = np.array([1.0, -np.sqrt(399.0)]), np.array([1.0, np.sqrt(399.0)]), 1.0 / 20.0


@pytest.mark.parametrize(
    ("origin", "target"),
    [
        ((0.0, 0.0), (0.0, 0.0)),  # both at the centre: every point of the wall is a Fermat point
        ((0.0, 0.0), (1e-9, 1e-9)),
        ((0.0, 0.0), (3.0, 4.0)),
        ((-5.0, 2.0), (-5.0, 2.0)),  # target = radar
        ((5.0, 2.0), (20.0, 0.0)),  # target on the wall
        ((20.0, 0.0), (5.0, 2.0)),  # radar on the wall
        ((20.0, 0.0), (20.0, 0.0)),
        ((5.0, 2.0), (1.0, np.sqrt(399.0))),  # target on the wall's end
        ((-1e6, 0.0), (-1e6, 5.0)),
        ((5.0, 2.0), (20.0 - 1e-7, 0.0)),
        ((20.0 - 1e-4, 0.0), (19.0, 6.0)),
    ],
)
def test_curved_mirror_survives_what_a_scene_should_not_hold(
    origin: tuple[float, float], target: tuple[float, float]
) -> None:
    """No NaN, no infinity, no warning, and a field no larger than the whole wall in phase."""
    found = bounces(np.array(origin), np.array([target]), *HOLLOW, 0.03)
    for values in (found.share, found.point_m, found.normal, found.out_m, found.on_m, found.cos_incidence, found.gain):
        assert np.isfinite(values).all()
    assert ((found.share >= 0.0) & (found.share <= 1.0)).all()
    # sqrt(k / 2 pi) times the arc's 60 m, times the spread of legs of at least a wavelength
    assert (np.abs(found.gain) < 61.0 * np.sqrt(1.0 / 0.03) * np.sqrt(1.0 / 0.03)).all()


@pytest.mark.hard("models.physics.curved_mirror", "geometrical optics, 1 / sqrt(1 - 2 kappa l1 l2 / ((l1 + l2) cos))",
                  1e-9, "relative",
                  "closed form: sqrt(k / 2 pi) times the arc over r sqrt(2 r), all in phase; quadrature to "
                  "rounding")  # fmt: skip
def test_whole_arc_in_phase_is_one_bounce(errors: Errors) -> None:
    """Radar and object at the arc's centre: every point of the wall is a Fermat point, and rays focus to infinity."""
    found = bounces(np.zeros(2), np.zeros((1, 2)), *HOLLOW, 0.03)
    assert len(found) == 1
    arc_m = 40.0 * np.arcsin(np.sqrt(399.0) / 20.0)
    expected = np.sqrt(1.0 / 0.03) * arc_m / (np.sqrt(40.0) * 20.0) * 40.0
    naive = np.abs(focusing(np.array(20.0), np.array(20.0), np.array(1.0), np.array(1.0 / 20.0)))
    errors(naive=float(naive / expected) - 1.0, ours=float(np.abs(np.abs(found.gain) / expected - 1.0).max()))


def wall_integral(origin: np.ndarray, target: np.ndarray, radius_m: float, reach_m: float) -> complex:
    """Kirchhoff's integral along a hollow arc about the point (radius, 0), summed in extended precision, at 10 GHz.

    sqrt(k / 2 pi) e^{j pi / 4} (c1 + c2) / 2 e^{-jkL} / sqrt(L l1 l2), heights by stationary phase; the last third
    of the arc to either side fades out as a cosine square, so that its ends do not diffract. 40 points a wavelength.
    """
    s = np.linspace(-reach_m, reach_m, int(80 * reach_m / WAVELENGTH_M) + 1, dtype=np.longdouble)
    turn = s / np.longdouble(radius_m)
    point = np.stack([radius_m * (1.0 - np.cos(turn)), radius_m * np.sin(turn)])
    normal = np.stack([np.cos(turn), -np.sin(turn)])
    legs = [np.asarray(place, np.longdouble)[:, None] - point for place in (origin, target)]
    (l1, c1), (l2, c2) = ((np.hypot(*leg), np.sum(leg * normal, axis=0) / np.hypot(*leg)) for leg in legs)
    k = 2 * np.longdouble(mp.nstr(mp.pi, 25)) / np.longdouble(WAVELENGTH_M)
    fade = np.cos(0.5 * np.pi * np.clip(3.0 * np.abs(s) / reach_m - 2.0, 0.0, 1.0)) ** 2
    field = np.sqrt(k / (2.0 * np.pi)) * 0.5 * (c1 + c2) / np.sqrt((l1 + l2) * l1 * l2)
    turns = (k * (l1 + l2)) % (2 * np.longdouble(mp.nstr(mp.pi, 25)))
    values = fade * field * (np.cos(turns) - 1j * np.sin(turns))
    return complex(np.exp(0.25j * np.pi) * np.sum(values) * (s[1] - s[0]))


@pytest.mark.hard("models.physics.curved_mirror",
                  "the ray of geometrical optics, 1 / sqrt(1 - 2 kappa l1 l2 / ((l1 + l2) cos))", 0.01, "of the field",
                  "RAY_ERROR, where rays give way to the integral; reference: the integral in extended "
                  "precision")  # fmt: skip
def test_concave_wall_focuses_at_its_caustic(errors: Errors) -> None:
    """A wall of 40 m radius, objects before, on and behind the image of the radar 30 m from it: rays diverge there."""
    radius_m, reach_m, origin = 40.0, 30.0, np.array([30.0, 0.0])
    a, b = (np.array([radius_m * (1.0 - np.cos(s)), radius_m * np.sin(s)]) for s in (-0.75, 0.75))
    image_m = 1.0 / (2.0 / radius_m - 1.0 / 30.0)
    naive, ours = [], []
    for beyond_m in (-1.0, -0.3, 0.0, 1e-9, 0.3, 1.0):
        on_m = image_m + beyond_m
        target = np.array([on_m, 0.0])
        exact = wall_integral(origin, target, radius_m, reach_m)
        found, field = one_way_field(origin, target[None], a, b, -1.0 / radius_m, WAVELENGTH_M)
        assert CAUSTIC in found.kind
        ray = focusing(np.array(30.0), np.array(on_m), np.array(1.0), np.array(1.0 / radius_m))
        naive.append(abs(ray / (30.0 + on_m) / exact) - 1.0)
        ours.append(field.sum() / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.curved_mirror", "spreading from the image at 1 / (2 kappa - 1 / l1)", 2e-15,
                  "relative",
                  "four roundings (1e-16 each) of 1 - 2 kappa l1 l2 / (l1 + l2) over its 0.15, halved by the root; "
                  "the root")  # fmt: skip
def test_far_image_of_a_radar_in_the_focus(errors: Errors) -> None:
    """A radar 20 m before a wall of 40 m radius has its image at infinity: infinity over itself."""
    naive, ours = [], []
    for out_m in (20.0 - 1e-9, 20.0, 20.0 + 1e-9):
        for on_m in (1.0, 50.0, 110.0):
            l1, l2 = Fraction(out_m), Fraction(on_m)
            exact = float(1 / (1 - l1 * l2 / 20 / (l1 + l2))) ** 0.5
            with np.errstate(divide="ignore", invalid="ignore"):
                image_m = np.float64(1.0) / (0.05 - 1.0 / out_m)
                spread = image_m / (image_m - on_m) * (out_m + on_m) / out_m
            naive.append(np.sqrt(np.abs(spread)) / exact - 1.0)
            found = focusing(np.array(out_m), np.array(on_m), np.array(1.0), np.array(0.025))
            ours.append(complex(found) / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("models.physics.curved_mirror", "centre plus radius times the unit vector", 2e-14, "m",
                  "rounding of 20 m in float64")  # fmt: skip
def test_a_nearly_flat_wall_has_a_far_centre(errors: Errors) -> None:
    """Curvatures of 1e-6 to 1e-12 1/m: the centre is up to 1e12 m away, and its distance known to 1e-4 m."""
    a, b, share = np.array([0.0, 0.0]), np.array([20.0, 0.0]), np.linspace(0.0, 1.0, 21)
    naive, ours = [], []
    for curvature in (1e-6, -1e-9, 1e-12):
        with mp.workdps(60):
            radius = 1 / mpf(curvature)
            half = mp.asin(10 / radius)
            turns = [half * (2 * mpf(float(one)) - 1) for one in share]
            sagitta = [float(radius * (mp.cos(half) - mp.cos(turn))) for turn in turns]
            exact = np.array([[float(10 + radius * mp.sin(turn)) for turn in turns], sagitta])
        centre_m = np.sqrt(1.0 / curvature**2 - 100.0) * np.sign(curvature)
        turn = np.arcsin(10.0 * curvature) * (2.0 * share - 1.0)
        naive.append(np.array([10.0 + np.sin(turn) / curvature, centre_m - np.cos(turn) / curvature]) - exact)
        ours.append(arc_points(a, b, curvature, share).T - exact)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


@pytest.mark.hard("tests.models.physics.curved_reference", "(-b +- sqrt(b^2 - 4 a c)) / 2 a of ray and circle", 0.0,
                  "of 6,000 rays told wrong",
                  "a wall bent by less than 1e-9 m cuts what the flat one cuts")  # fmt: skip
def test_rays_and_a_nearly_flat_wall(errors: Errors) -> None:
    """1e-12 and 1e-18 1/m, from either side: the root that matters is a difference of equals over next to nothing."""
    a, b = np.array([0.0, 0.0]), np.array([20.0, 0.0])
    targets = np.random.default_rng(15).uniform(-30.0, 30.0, (1000, 2))
    wrong, naively = 0, 0
    for curvature in (1e-12, -1e-12, 1e-18):
        for origin in (np.array([4.0, 9.0]), np.array([4.0, -9.0])):
            flat = crosses(origin, targets, a[None], b[None])[:, 0]
            wrong += int((arc_crosses(origin, targets, a, b, curvature) != flat).sum())
            naively += int((naive_arc_crosses(origin, targets, curvature) != flat).sum())
    errors(naive=naively, ours=wrong)


def naive_arc_crosses(origin: np.ndarray, targets: np.ndarray, curvature: float) -> np.ndarray:
    """Rays that meet the circle through (0, 0) and (20, 0) between these two, by both roots as at school."""
    ray, start = targets - origin, origin - [10.0, 0.0]
    second = 0.5 * curvature * np.sum(ray**2, axis=1)
    first = curvature * (ray @ start) - ray[:, 1]
    root = np.sqrt(first**2 - 2.0 * second * (curvature * (start @ start - 100.0) - 2.0 * start[1]))
    cut = np.zeros(len(targets), bool)
    for way in ((-first + root) / (2.0 * second), (-first - root) / (2.0 * second)):
        cut |= (way > 0.0) & (way < 1.0) & (np.abs(start[0] + way * ray[:, 0]) <= 10.0)
    return cut


def exact_edge_terms(beyond_rad: float) -> complex:
    """Both incident terms of a thin wall's end (n = 2, k L = 2,096), unscaled, so far into the shadow; 40 digits."""
    with mp.workdps(40):
        kl, beta = 20 * mp.pi / mpf(WAVELENGTH_M), mp.pi + mpf(beyond_rad)
        root = mp.sqrt(2 * kl) * abs(mp.cos(beta / 2))
        scaled = mp.sqrt(mp.pi) * mp.expj(mp.pi / 4 + root**2) * root * mp.erfc(mp.expj(mp.pi / 4) * root)
        return complex((mp.cot((mp.pi + beta) / 4) + mp.cot((mp.pi - beta) / 4)) * scaled)


@pytest.mark.hard("models.physics.diffraction", "cot((pi - beta) / 4) F(k L a)", 1.5e-5, "relative",
                  "next order of F, 2 sqrt(x / pi), where the limit takes over: 2e-7 rad, k L = 2,100")  # fmt: skip
def test_object_on_the_border_of_a_walls_shadow(errors: Errors) -> None:
    """Radar, wall's end and object in line, to 1e-16 and on the dark side: infinity times nothing, twice rounded."""
    kl = 20.0 * np.pi / WAVELENGTH_M
    scale = -np.exp(-0.25j * np.pi) / (4.0 * np.sqrt(2.0 * np.pi * 2.0 * np.pi / WAVELENGTH_M))
    naive, ours = [], []
    for beyond_rad in (-1e-3, -1e-6, 0.0, 1e-12, 1e-9, 3e-7, 5e-7, 1e-6, 1e-3):
        target = np.pi + beyond_rad
        # on the border itself the dark side's limit: a step of 1e-30 beyond it
        exact = exact_edge_terms(float(beyond_rad or 1e-30))
        x = 2.0 * kl * np.cos(0.5 * target) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            cotangents = 1.0 / np.tan(0.25 * (np.pi + target)) + 1.0 / np.tan(0.25 * np.float64(np.pi - target))
            transition = (
                1j * np.sqrt(np.pi * x) * np.exp(-0.25j * np.pi) * wofz(1j * np.exp(0.25j * np.pi) * np.sqrt(x))
            )
            naive.append(cotangents * transition / exact - 1.0)
        found = wedge_terms_at(2.0, 0.0, float(target), 10.0, WAVELENGTH_M, 1.0)
        ours.append(found[0] / scale / exact - 1.0)
    errors(naive=np.abs(naive).max(), ours=np.abs(ours).max())


def test_nearly_flat_and_nearly_half_circles() -> None:
    """Curvature 1e-12 1/m, and |curvature| x chord from 2 down to one rounding below it; at 2 the arc is refused."""
    a, b = np.array([0.0, 0.0]), np.array([20.0, 0.0])
    rng = np.random.default_rng([40, 9])
    targets = rng.uniform(-30.0, 30.0, (200, 2))
    for curvature in (1e-12, -1e-12, 5e-324, 0.1 * (1.0 - 1e-9), -np.nextafter(0.1, 0.0)):
        found = bounces(np.array([4.0, 9.0]), targets, a, b, curvature, 0.03)
        assert len(found) > 0
        assert np.isfinite(found.gain).all()
        assert np.isfinite(found.point_m).all()
    with pytest.raises(ValueError, match="less than a half circle"):
        bounces(np.array([4.0, 9.0]), targets, a, b, 0.1, 0.03)


def test_no_targets_no_bounces() -> None:
    assert len(bounces(np.zeros(2), np.zeros((0, 2)), *HOLLOW, 0.03)) == 0


@pytest.mark.hard("sim_player.effects.los_surfaces",
                  "a flash of each piece on which the foot's share of the length lies within 0..1", 1e-6,
                  "of the flash of the facade in one piece",
                  "a facade's field does not depend on how many pieces it is drawn in")  # fmt: skip
def test_foot_on_a_joint_in_any_direction(errors: Errors) -> None:
    """A facade in two pieces that meet at the foot of the perpendicular, turned by 100 angles: rounding puts the foot
    on both, on one or on none of them.
    """
    naive, ours = [], []
    for turn in np.random.default_rng(4).uniform(-np.pi, np.pi, 100):
        cosine, sine = np.cos(turn), np.sin(turn)
        low, foot, high = (np.array([20.0 * cosine - y * sine, 20.0 * sine + y * cosine]) for y in (-30.0, 0.0, 40.0))
        along = (high - low) / 70.0
        naive.append(sum(0.0 <= -(a @ along) <= 1.0 * ((b - a) @ along) for a, b in ((low, foot), (foot, high))) - 1)
        one, two = (_flash(*points) for points in ((low, high), (low, foot, high)))
        ours.append(abs(two / one - 1.0))
    errors(naive=float(np.abs(naive).max()), ours=max(ours))


def _flash(*points: np.ndarray) -> complex:
    """Field of the echoes within a metre of the foot of a wall 20 m away."""
    surface = Surface(role="relay", material="metal", polyline_m=tuple((float(x), float(y)) for x, y in points))
    view = snapshot(prepare(Scene(name="facade", surfaces=(surface,))))
    echoes = los_surfaces._flashes(view)
    echoes = echoes.take(echoes.out_m < 20.02)
    phase = np.exp(-2j * np.pi / WAVELENGTH_M * (echoes.out_m + echoes.back_m))
    return complex(np.sum(echoes.weight * echoes.whole * phase))
