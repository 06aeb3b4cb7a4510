"""What a driver should be told, from what the graph says: rules, and the memory that keeps them from flickering.

A rule looks at the facts of one moment and finds conditions; it never guesses: what cannot be told is not said. The
memory adds hysteresis (a wider limit ends a warning than begins it, and it stays for a moment after), the time of the
first occurrence, and order. Nothing here knows a page or a clock: `Warner.step` is asked with the time it is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import msgspec
import numpy as np

from msgs.values.arrays import require_positive
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track, Visibility
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion
from msgs.values.wording import counted
from nodes.inputs.view_latency import ViewFigures, on_one_clock


class Level(IntEnum):
    """How soon something must be done about it."""

    NOTICE = 1
    CAUTION = 2
    URGENT = 3


class WarningParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Limits of the rules; each `until` ends what its neighbour above begins."""

    #: An object that comes into direct sight within this time.
    appear_s: float = 3.0
    appear_until_s: float = 4.0
    #: Ways that come this near, with a standard deviation of the distance no larger than that, within `crossing_s`.
    crossing_m: float = 3.0
    crossing_until_m: float = 4.5
    crossing_s: float = 4.0
    crossing_until_s: float = 5.0
    crossing_step_s: float = 0.1
    #: An object moves if it is faster than this and than `moving_sigmas` standard deviations of its speed.
    moving_mps: float = 1.0
    moving_sigmas: float = 2.0
    #: A track that was not seen in more scans than this begins no warning.
    max_misses: int = 2
    #: Less of the plane than this is observed in mirrors: it cannot see.
    blind_m2: float = 10.0
    blind_until_m2: float = 20.0
    #: A radar without scan, a vehicle without state.
    silent_s: float = 1.0
    vehicle_silent_s: float = 0.5
    #: Views late or absent within the window of `live_timing`.
    late_views: int = 2
    #: Straight ahead reaches this far to either side.
    ahead_deg: float = 10.0
    #: What concerns seeing at all must last this long before it is said; a warning stays this long after its end.
    settle_s: float = 0.5
    stay_s: float = 1.0
    #: More than this are not shown: the most urgent are.
    most: int = 12

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            require_positive(f"warnings.{name}", getattr(self, name))
        for name in ("appear_s", "crossing_m", "crossing_s", "blind_m2"):
            stem, _, unit = name.rpartition("_")
            until = getattr(self, f"{stem}_until_{unit}")
            if until < getattr(self, name):
                raise ValueError(f"warnings.{stem}_until_{unit} must be at least {name}, got {until!r}")


#: Conditions of a view in plain words: what it is, and what follows from it.
FLAG_WORDS = {
    "incoherent": ("Echoes moved during the scan", "bearings are less exact"),
    "missing_beams": ("Beams are missing", "nothing is seen in their directions"),
    "saturated": ("The receiver is overdriven", "a strong echo may hide weak ones or show ghosts"),
    "lost_chirps": ("Parts of the radar signal were lost", "weak echoes may be missed"),
    "silent_beams": ("A beam hears nothing", "it was left out; nothing is seen in its direction"),
    "drowned_beams": ("Another transmitter disturbs a beam", "it was left out; nothing is seen in its direction"),
    "spurs": ("The radar disturbs itself", "echoes may appear where nothing is"),
    "array_error": ("The antenna is not as calibrated", "bearings may be wrong; calibrate the radar"),
}
#: The nearest so many are looked at.
MOST_TRACKS = 100
#: Frequent where things move, and no fault.
_HARMLESS_FLAGS = ("incoherent",)


class NodeFact(NamedTuple):
    """A node as its heartbeats say: state, why, messages lost or unreadable in the last seconds."""

    node: str
    state: str
    reason: str
    lost: int


class Facts(NamedTuple):
    """All that is known at a time; stamps on the clock of `now_ns`, None: never came."""

    now_ns: int
    since_ns: int
    frame: BevFrame | None = None
    frame_at_ns: int | None = None
    #: When a radar map last came: tells a silent radar from silent perception.
    map_at_ns: int | None = None
    vehicle: VehicleState | None = None
    vehicle_at_ns: int | None = None
    views: ViewFigures | None = None
    nodes: Sequence[NodeFact] = ()
    vehicle_from_radar: Pose2 = Pose2()
    #: What looks: "radar" or "LiDAR", and how long a scan takes.
    sensor: str = "radar"
    scan_period_s: float = 0.0


class Finding(NamedTuple):
    """A condition that holds now. Not `firm`: enough to keep a warning, not to begin one."""

    key: str
    level: Level
    title: str
    detail: str
    firm: bool = True
    #: Time left, None where there is none to speak of.
    left_s: float | None = None
    #: Must last this long before it is said.
    after_s: float = 0.0
    tracks: tuple[int, ...] = ()
    #: What is not firm keeps only a warning of its own kind.
    kind: str = ""


class DriverWarning(NamedTuple):
    """A warning as it stands: its key stays while it lasts, title, level and detail follow what is known.

    `ended`: the condition has just gone. `left_s`: time to the event. `since_ns`: when it became as urgent as now.
    """

    key: str
    level: Level
    title: str
    detail: str
    since_ns: int
    left_s: float | None
    tracks: tuple[int, ...]
    ended: bool


class _Known(NamedTuple):
    """What is remembered of a key."""

    #: Since when it has been of that level at least, for each level up to its own.
    since_ns: dict[Level, int]
    last_ns: int
    said: bool
    finding: Finding


class Warner:
    """Findings made into warnings that do not flicker; asked in order of time, belongs to one thread."""

    def __init__(self, params: WarningParams | None = None) -> None:
        self._params = params or WarningParams()
        self._known: dict[str, _Known] = {}
        self._now_ns: int | None = None

    def step(self, facts: Facts) -> tuple[DriverWarning, ...]:
        """Return the warnings at `facts.now_ns`, the most urgent first; a clock that went back begins anew."""
        now_ns = facts.now_ns
        if self._now_ns is not None and now_ns < self._now_ns:
            self._known.clear()
        self._now_ns = now_ns
        heard: set[str] = set()
        for finding in findings(facts, self._params):
            # the first that counts speaks for its key
            if finding.key not in heard and self._hear(finding, now_ns):
                heard.add(finding.key)
        self._known = {key: one for key, one in self._known.items() if self._is_kept(one, now_ns)}
        warnings = [_warning(one, now_ns) for one in self._known.values() if one.said]
        return tuple(sorted(warnings, key=_by_urgency)[: self._params.most])

    def _hear(self, finding: Finding, now_ns: int) -> bool:
        """Remember a finding; False where it does not count: too weak to begin, or to take the place of a worse one."""
        known = self._known.get(finding.key)
        if not finding.firm and (known is None or known.finding.kind != finding.kind):
            return False
        if known is not None and finding.level < known.finding.level and self._stays(known, now_ns):
            return False
        before = {} if known is None else known.since_ns
        since_ns = {level: before.get(level, now_ns) for level in Level if level <= finding.level}
        said = (known is not None and known.said) or s_from_ns(now_ns - min(since_ns.values())) >= finding.after_s
        self._known[finding.key] = _Known(since_ns, now_ns, said, finding)
        return True

    def _stays(self, one: _Known, now_ns: int) -> bool:
        return one.said and s_from_ns(now_ns - one.last_ns) <= self._params.stay_s

    def _is_kept(self, one: _Known, now_ns: int) -> bool:
        return one.last_ns == now_ns or self._stays(one, now_ns)


def _warning(one: _Known, now_ns: int) -> DriverWarning:
    finding = one.finding
    left_s = None if finding.left_s is None else max(finding.left_s - s_from_ns(now_ns - one.last_ns), 0.0)
    since_ns, ended = one.since_ns[finding.level], one.last_ns < now_ns
    return DriverWarning(
        finding.key, finding.level, finding.title, finding.detail, since_ns, left_s, finding.tracks, ended
    )


def _by_urgency(one: DriverWarning) -> tuple[bool, int, float, int, str]:
    """What has ended goes last, then by level, time left, age."""
    return one.ended, -one.level, math.inf if one.left_s is None else one.left_s, one.since_ns, one.key


def findings(facts: Facts, params: WarningParams) -> list[Finding]:
    """Return all conditions that hold; of several with one key the first that counts is meant."""
    return [one for rule in RULES for one in rule(facts, params)]


def _is_fresh(facts: Facts, params: WarningParams) -> bool:
    return facts.frame_at_ns is not None and s_from_ns(facts.now_ns - facts.frame_at_ns) <= _silent_s(facts, params)


def _silent_s(facts: Facts, params: WarningParams) -> float:
    """How long it takes to be silent: a few scans, where they are slow."""
    return max(params.silent_s, 3.0 * facts.scan_period_s)


def _vehicle_age_s(facts: Facts) -> float:
    return math.inf if facts.vehicle_at_ns is None else s_from_ns(facts.now_ns - facts.vehicle_at_ns)


def _is_motion_known(facts: Facts, params: WarningParams) -> bool:
    return facts.vehicle is not None and facts.vehicle.valid and _vehicle_age_s(facts) <= params.vehicle_silent_s


# hidden road users


def hidden_objects(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Return of each side whose ways cross, then who comes into sight, then who moves there; the most urgent first.

    A side, not a track, has the key: one vehicle that is followed twice, or under a new id, is one warning.
    """
    frame = facts.frame
    if frame is None or not _is_fresh(facts, params):
        return
    tracks = [one for one in frame.tracks if _makes_sense(one)]
    count = Counter(side_of_track(one, params) for one in tracks)
    tracks = sorted(tracks, key=lambda one: math.hypot(one.x_m, one.y_m))[:MOST_TRACKS]
    crossings = _crossings(facts, tracks, params)
    # tracks speak of the scan's stamp, a driver of now
    late_s = s_from_ns(facts.now_ns - frame.stamp_ns) if on_one_clock(frame.stamp_ns, facts.now_ns) else 0.0
    found = [
        finding._replace(detail=finding.detail + _others(count[side_of_track(one, params)] - 1))
        for one, crossing in zip(tracks, crossings, strict=True)
        for finding in _about_track(one, crossing, late_s, params)
    ]
    yield from sorted(found, key=_what_first)
    if not frame.tracks:
        yield from _untracked(frame, params)


def _what_first(one: Finding) -> tuple[int, bool, bool, float]:
    """Return ways that meet go before what comes into sight, even where they only keep a warning."""
    return -one.level, one.kind != "meet", not one.firm, math.inf if one.left_s is None else one.left_s


def _others(count: int) -> str:
    return f"; {count} more on this side" if count > 0 else ""


def _makes_sense(one: Track) -> bool:
    return all(map(math.isfinite, (one.x_m, one.y_m, one.velocity_x_mps, one.velocity_y_mps)))


class Crossing(NamedTuple):
    """Two ways that come near: when they first do, how near at last, the standard deviation of the distance then."""

    time_s: float
    distance_m: float
    std_m: float


def _about_track(one: Track, crossing: Crossing | None, late_s: float, params: WarningParams) -> Iterable[Finding]:
    """What is to be said of one track, and, where that is not firm, what is said instead."""
    place, moves = place_words(one.x_m, one.y_m), is_moving(one, params)
    side, seen = side_of_track(one, params), one.misses <= params.max_misses
    who = f"{'Hidden road user' if moves else 'Slow or standing hidden object'} {side_words(side)}"
    detail = f"{place}, {speed_words(one)}" if moves else place
    about = Finding(f"hidden/{side}", Level.NOTICE, who, detail, seen, after_s=params.settle_s, tracks=(one.id,))
    if crossing is not None:
        yield _meeting(about, crossing, late_s, params)
    if one.time_to_appear_s == 0.0:
        in_sight = f"now in direct sight, {place}"
        yield about._replace(kind="appear", level=Level.CAUTION, detail=in_sight, firm=False)
        return
    if one.time_to_appear_s is not None and one.time_to_appear_s - late_s <= params.appear_until_s:
        left_s = max(one.time_to_appear_s - late_s, 0.0)
        yield about._replace(
            kind="appear",
            level=Level.URGENT if moves else Level.CAUTION,
            title=f"{who}: about to appear",
            firm=seen and left_s <= params.appear_s,
            left_s=left_s,
            after_s=0.0,
        )
    if moves:
        yield about


def _meeting(about: Finding, crossing: Crossing, late_s: float, params: WarningParams) -> Finding:
    """Return ways that come near each other, firm where that is near, sure and soon."""
    left_s = max(crossing.time_s - late_s, 0.0)
    apart = f"{crossing.distance_m:.1f} m (± {crossing.std_m:.1f} m) apart if both go on so"
    return about._replace(
        kind="meet",
        level=Level.URGENT,
        title=f"{about.title}: ways meet",
        detail=f"{apart}; {about.detail}",
        firm=about.firm
        and max(crossing.distance_m, crossing.std_m) <= params.crossing_m
        and left_s <= params.crossing_s,
        left_s=left_s,
        after_s=0.0,
    )


def _untracked(frame: BevFrame, params: WarningParams) -> Iterable[Finding]:
    """Return objects of a view without tracks: there, but nobody knows yet how they move."""
    for one in frame.objects:
        if math.isfinite(one.x_m) and math.isfinite(one.y_m):
            side = side_of(one.x_m, one.y_m, params)
            title = f"Hidden object {side_words(side)}"
            detail = f"{place_words(one.x_m, one.y_m)}; not followed, motion unknown"
            yield Finding(f"hidden/{side}", Level.NOTICE, title, detail, after_s=params.settle_s)


def is_moving(one: Track, params: WarningParams) -> bool:
    """Return whether the speed of a track is beyond doubt not zero."""
    velocity = np.array([one.velocity_x_mps, one.velocity_y_mps])
    speed_mps = float(np.hypot(*velocity))
    if speed_mps <= params.moving_mps:
        return False
    covariance = one.velocity_cov_m2ps2
    if covariance is None:
        return True
    return speed_mps > params.moving_sigmas * _std_along(velocity / speed_mps, np.array(covariance))


def _std_along(direction: np.ndarray, covariance: np.ndarray) -> float:
    """Return standard deviation in a direction [2]; infinite where the covariance [2, 2] is not finite."""
    if not np.isfinite(covariance).all():
        return math.inf
    return math.sqrt(max(float(direction @ covariance @ direction), 0.0))


def _crossings(facts: Facts, tracks: Sequence[Track], params: WarningParams) -> list[Crossing | None]:
    """Of each track where its way and the radar's first come near; None where they do not, or nobody can tell."""
    state = facts.vehicle
    if state is None or not _is_motion_known(facts, params):
        return [None] * len(tracks)
    count = round(params.crossing_until_s / params.crossing_step_s) + 1
    times_s = params.crossing_step_s * np.arange(count)
    radar_m = radar_ahead_m(state, facts.vehicle_from_radar, times_s)
    return [crossing_of(one, radar_m, times_s, params.crossing_until_m) for one in tracks]


def radar_ahead_m(state: VehicleState, vehicle_from_radar: Pose2, times_s: np.ndarray) -> np.ndarray:
    """Return places [N, 2] of the radar in its own axes of now, if the vehicle keeps speed and yaw rate."""
    radar_from_vehicle = vehicle_from_radar.inverse()
    motions = (ego_motion(state.speed_mps, state.yaw_rate_rps, time_s) for time_s in times_s.tolist())
    poses = (radar_from_vehicle @ motion @ vehicle_from_radar for motion in motions)
    return np.array([[pose.x_m, pose.y_m] for pose in poses])


def crossing_of(one: Track, radar_m: np.ndarray, times_s: np.ndarray, near_m: float) -> Crossing | None:
    """The nearest approach of a track to the radar's way [N, 2] at `times_s` [N], and when `near_m` is first reached.

    None where it never is, where they move apart from the start, or where the velocity's covariance is not known, a
    covariance is not finite, or they leave the distance less certain than `near_m`.
    """
    if one.velocity_cov_m2ps2 is None or not np.isfinite((one.cov_m2, one.velocity_cov_m2ps2)).all():
        return None
    start = np.array([one.x_m, one.y_m])
    offsets = start + times_s[:, None] * np.array([one.velocity_x_mps, one.velocity_y_mps]) - radar_m
    distances_m = np.hypot(offsets[:, 0], offsets[:, 1])
    first, nearest = int(np.argmax(distances_m <= near_m)), int(distances_m.argmin())
    if distances_m[nearest] > near_m or nearest == 0:
        return None
    spread = np.array(one.cov_m2) + times_s[first] ** 2 * np.array(one.velocity_cov_m2ps2)
    along = offsets[first] / max(distances_m[first], 1e-9)
    std_m = _std_along(along, spread)
    # too vague: nobody can tell
    if std_m > near_m:
        return None
    return Crossing(float(times_s[first]), float(distances_m[nearest]), std_m)


def side_of(x_m: float, y_m: float, params: WarningParams) -> str:
    """Return side of a place: ahead, left, right, behind."""
    azimuth_deg = math.degrees(math.atan2(y_m, x_m))
    if abs(azimuth_deg) <= params.ahead_deg:
        return "ahead"
    if abs(azimuth_deg) > 120.0:
        return "behind"
    return "left" if azimuth_deg > 0.0 else "right"


def side_of_track(one: Track, params: WarningParams) -> str:
    """Return side of a track; one that is straight ahead and crosses comes from where it came from."""
    side = side_of(one.x_m, one.y_m, params)
    crosses = abs(one.velocity_y_mps) > max(abs(one.velocity_x_mps), params.moving_mps)
    if side == "ahead" and crosses:
        return "left" if one.velocity_y_mps < 0.0 else "right"
    return side


def side_words(side: str) -> str:
    """Return  "from the left", "ahead", "behind"."""
    return f"from the {side}" if side in ("left", "right") else side


def speed_words(one: Track) -> str:
    """Return speed over ground: "14 km/h"."""
    return f"{3.6 * math.hypot(one.velocity_x_mps, one.velocity_y_mps):.0f} km/h"


def place_words(x_m: float, y_m: float) -> str:
    """Return distance and bearing: "18 m, 35° left"."""
    azimuth_deg = round(math.degrees(math.atan2(y_m, x_m)))
    bearing = "straight ahead" if azimuth_deg == 0 else f"{abs(azimuth_deg)}° {'left' if azimuth_deg > 0 else 'right'}"
    return f"{math.hypot(x_m, y_m):.0f} m, {bearing}"


# seeing at all


def silence(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Return no view for longer than a few scans: of a silent radar, or of a perception that does not follow it."""
    if facts.frame_at_ns is None:
        waited_s = s_from_ns(facts.now_ns - facts.since_ns)
        if waited_s > _silent_s(facts, params):
            yield Finding("silent", Level.CAUTION, "No view yet", f"waiting for {waited_s:.0f} s")
    elif not _is_fresh(facts, params):
        quiet = f"no view for {s_from_ns(facts.now_ns - facts.frame_at_ns):.0f} s"
        yield Finding("silent", Level.URGENT, *_who_is_silent(facts, quiet, params))


def _who_is_silent(facts: Facts, quiet: str, params: WarningParams) -> tuple[str, str]:
    """Return title and detail of a silence; where no map ever came nobody can tell whose it is."""
    if facts.map_at_ns is None:
        return "No view", quiet
    map_age_s = s_from_ns(facts.now_ns - facts.map_at_ns)
    if map_age_s > _silent_s(facts, params):
        return f"No view: the {facts.sensor} is silent", f"no scan for {map_age_s:.0f} s"
    return "No view: perception is silent", f"scans come, {quiet}"


def blindness(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Nothing observed in any mirror: an empty view then means nothing."""
    if facts.frame is None or not _is_fresh(facts, params):
        return
    cells = int(np.count_nonzero(facts.frame.visibility == Visibility.MIRRORED))
    area_m2 = cells * facts.frame.grid.cell_m**2
    if area_m2 >= params.blind_until_m2:
        return
    why = "no wall found to look round with" if not facts.frame.walls else "no wall mirrors what is hidden"
    if facts.frame.walls and facts.sensor != "radar":
        why = "what it would see of an object is not known"
    firm = area_m2 < params.blind_m2
    title = "Cannot see round corners"
    yield Finding("blind", Level.CAUTION, title, f"{why}; an empty view means nothing", firm, after_s=params.settle_s)


def conditions(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """What the scan says of itself."""
    if facts.frame is None or not _is_fresh(facts, params):
        return
    for flag in facts.frame.flags:
        title, detail = FLAG_WORDS.get(flag, (flag.replace("_", " ").capitalize(), "the scan says so of itself"))
        level = Level.NOTICE if flag in _HARMLESS_FLAGS else Level.CAUTION
        yield Finding(f"flag/{flag}", level, title, detail, after_s=params.settle_s)


def own_motion(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Without any vehicle state the radar is taken as standing; after the last one nothing can be followed."""
    age_s = _vehicle_age_s(facts)
    if facts.vehicle is None:
        if facts.frame is not None:
            so = f"the {facts.sensor} is taken as standing"
            yield Finding("vehicle", Level.NOTICE, "No vehicle state", so, after_s=params.settle_s)
    elif age_s > params.vehicle_silent_s or not facts.vehicle.valid:
        reason = facts.vehicle.reason or "the vehicle state is not valid"
        why = f"no vehicle state for {age_s:.1f} s" if age_s > params.vehicle_silent_s else reason
        yield Finding("vehicle", Level.CAUTION, "Own motion unknown", f"{why}; hidden objects cannot be followed")


def lateness(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Return views that come too late, or not at all."""
    views = facts.views
    if views is None or views.misses + views.overdue == 0:
        return
    firm = views.misses + views.overdue >= params.late_views
    detail = f"{views.late} later than {views.deadline_s:g} s and {views.absent} missing in {views.window_s:.0f} s"
    yield Finding("late", Level.CAUTION, "Views come late", detail, firm)


def nodes(facts: Facts, params: WarningParams) -> Iterable[Finding]:
    """Return parts of the graph that are not well, and what was lost between them."""
    for node in facts.nodes:
        if node.state in ("degraded", "silent"):
            detail = node.reason or "it gives no reason"
            yield Finding(f"node/{node.node}", Level.CAUTION, f"{node.node} is {node.state}", detail)
        if node.lost > 0:
            detail = f"{counted(node.lost, 'message')} did not reach it lately"
            yield Finding(f"lost/{node.node}", Level.CAUTION, f"{node.node} loses messages", detail)


RULES: tuple[Callable[[Facts, WarningParams], Iterable[Finding]], ...] = (
    silence,
    hidden_objects,
    blindness,
    own_motion,
    conditions,
    lateness,
    nodes,
)


def warnings_json(warnings: Sequence[DriverWarning], now_ns: int) -> list[dict[str, Any]]:
    """Return warnings for a page: how long they have lasted instead of when they began."""
    return [
        {
            "key": one.key,
            "level": one.level.name.lower(),
            "title": one.title,
            "detail": one.detail,
            "left_s": None if one.left_s is None else round(one.left_s, 1),
            "age_s": round(s_from_ns(now_ns - one.since_ns), 1),
            "tracks": list(one.tracks),
            "ended": one.ended,
        }
        for one in warnings
    ]
