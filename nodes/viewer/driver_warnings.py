"""Warnings for a driver from the messages of the graph: rules, and the memory that keeps them from flickering.

A rule checks the facts of one moment for conditions; it never guesses: an undetermined condition gives no warning.
The memory adds hysteresis (a wider limit ends a warning than begins it, and it stays for a moment after), the time of
the first occurrence, and order. Nothing here depends on a page or a clock: `Warner.step` is called with the time.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track, Visibility
from msgs.values.units import s_from_ns
from msgs.values.vehicle import VehicleState, ego_motion
from msgs.values.wording import counted
from nodes.inputs.view_latency import ViewFigures, on_one_clock


class Level(IntEnum):
    """Urgency of a warning."""

    NOTICE = 1
    CAUTION = 2
    URGENT = 3


#: An object that enters direct sight within this time.
APPEAR_S = 3.0
APPEAR_UNTIL_S = 4.0
#: Paths that come this near, with a standard deviation of the distance no larger than that, within `CROSSING_S`.
CROSSING_M = 3.0
CROSSING_UNTIL_M = 4.5
CROSSING_S = 4.0
CROSSING_UNTIL_S = 5.0
CROSSING_STEP_S = 0.1
#: An object moves if it is faster than this and than `MOVING_SIGMAS` standard deviations of its speed.
MOVING_MPS = 1.0
MOVING_SIGMAS = 2.0
#: A track missed in more scans than this begins no warning.
MAX_MISSES = 2
#: With a smaller share of the plane observed in mirrors the radar counts as blind.
BLIND_M2 = 10.0
BLIND_UNTIL_M2 = 20.0
#: A radar without scan, a vehicle without state.
SILENT_S = 1.0
VEHICLE_SILENT_S = 0.5
#: Views late or absent within the window of `live_timing`.
LATE_VIEWS = 2
#: Lateral limit of "straight ahead".
AHEAD_DEG = 10.0
#: Minimum duration of a visibility condition before its warning; a warning stays this long after its end.
SETTLE_S = 0.5
STAY_S = 1.0
#: Maximum number of warnings shown: the most urgent ones.
MAX_WARNINGS = 12


#: Conditions of a view in plain words: the condition, and its consequence.
FLAG_WORDS = {
    "incoherent": ("Echoes moved during the scan", "bearings are less exact"),
    "missing_beams": ("Beams are missing", "nothing is seen in their directions"),
    "saturated": ("The receiver is overdriven", "a strong echo may hide weak ones or show ghosts"),
    "lost_chirps": ("Parts of the radar signal were lost", "weak echoes may be missed"),
    "silent_beams": ("A beam hears nothing", "it was left out; nothing is seen in its direction"),
    "drowned_beams": ("Another transmitter disturbs a beam", "it was left out; nothing is seen in its direction"),
    "spurs": ("The radar disturbs itself", "echoes may appear where nothing is"),
    "untrained_setup": ("The networks were trained for another radar", "objects may be missed or made up"),
    "array_error": ("The antenna is not as calibrated", "bearings may be wrong; calibrate the radar"),
    "i_stuck": ("The radar's I channel is dead", "half of what is shown is not there; check the wiring"),
    "q_stuck": ("The radar's Q channel is dead", "half of what is shown is not there; check the wiring"),
    "i_equals_q": ("The radar's channels carry one signal", "half of what is shown is not there; check the wiring"),
    "iq_exchanged": ("The radar's channels are exchanged", "nothing is seen; check the wiring or the set-up"),
    "i_bit_stuck": ("The radar's I converter has a dead bit", "echoes may be missed or made up; check the converter"),
    "q_bit_stuck": ("The radar's Q converter has a dead bit", "echoes may be missed or made up; check the converter"),
}
#: Maximum number of tracks considered: the nearest.
MAX_TRACKS = 100
#: Frequent where objects move, and no fault.
_HARMLESS_FLAGS = ("incoherent",)


class NodeFact(NamedTuple):
    """A node according to its heartbeats: state, reason, messages lost or unreadable in the last seconds."""

    node: str
    state: str
    reason: str
    lost: int


class Facts(NamedTuple):
    """All facts at a time; stamps on the clock of `now_ns`, None: never received."""

    now_ns: int
    since_ns: int
    frame: BevFrame | None = None
    frame_at_ns: int | None = None
    #: When a radar map last came: distinguishes a silent radar from silent perception.
    map_at_ns: int | None = None
    vehicle: VehicleState | None = None
    vehicle_at_ns: int | None = None
    views: ViewFigures | None = None
    nodes: Sequence[NodeFact] = ()
    vehicle_from_radar: Pose2 = Pose2()
    #: The sensor, "radar" or "LiDAR", and the duration of a scan.
    sensor: str = "radar"
    scan_period_s: float = 0.0
    #: Since when the graph runs: the age of earlier stamps is not known.
    graph_since_ns: int = 0


class Finding(NamedTuple):
    """A condition that holds now. Not `firm`: enough to keep a warning, not to begin one."""

    key: str
    level: Level
    title: str
    detail: str
    firm: bool = True
    #: Time left, None if there is no meaningful one.
    left_s: float | None = None
    #: Minimum duration before it is shown.
    after_s: float = 0.0
    tracks: tuple[int, ...] = ()
    #: A finding that is not firm keeps only a warning of its own kind.
    kind: str = ""


class DriverWarning(NamedTuple):
    """A current warning: its key stays while it lasts; title, level and detail follow the facts.

    `ended`: the condition has just ended. `left_s`: time to the event. `since_ns`: when it became as urgent as now.
    """

    key: str
    level: Level
    title: str
    detail: str
    since_ns: int
    left_s: float | None
    tracks: tuple[int, ...]
    ended: bool


class _Memory(NamedTuple):
    """Memory of a key."""

    #: Start time of at least that level, for each level up to its own.
    since_ns: dict[Level, int]
    last_ns: int
    said: bool
    finding: Finding


class Warner:
    """Findings made into warnings that do not flicker; called in order of time, belongs to one thread."""

    def __init__(self) -> None:
        self._memory: dict[str, _Memory] = {}
        self._now_ns: int | None = None

    def step(self, facts: Facts) -> tuple[DriverWarning, ...]:
        """Return the warnings at `facts.now_ns`, the most urgent first; a clock that went back resets the memory."""
        now_ns = facts.now_ns
        if self._now_ns is not None and now_ns < self._now_ns:
            self._memory.clear()
        self._now_ns = now_ns
        keys: set[str] = set()
        for finding in findings(facts):
            # the first that counts represents its key
            if finding.key not in keys and self._store(finding, now_ns):
                keys.add(finding.key)
        self._memory = {
            key: memory
            for key, memory in self._memory.items()
            if (memory.last_ns == now_ns or self._stays(memory, now_ns))
        }
        warnings = [_warning(memory, now_ns) for memory in self._memory.values() if memory.said]
        return tuple(sorted(warnings, key=_by_urgency)[:MAX_WARNINGS])

    def _store(self, finding: Finding, now_ns: int) -> bool:
        """Store a finding; False if it does not count: too weak to begin, or to replace a worse one."""
        memory = self._memory.get(finding.key)
        if not finding.firm and (memory is None or memory.finding.kind != finding.kind):
            return False
        if memory is not None and finding.level < memory.finding.level and self._stays(memory, now_ns):
            return False
        before = {} if memory is None else memory.since_ns
        since_ns = {level: before.get(level, now_ns) for level in Level if level <= finding.level}
        said = (memory is not None and memory.said) or s_from_ns(now_ns - min(since_ns.values())) >= finding.after_s
        self._memory[finding.key] = _Memory(since_ns, now_ns, said, finding)
        return True

    def _stays(self, memory: _Memory, now_ns: int) -> bool:
        return memory.said and s_from_ns(now_ns - memory.last_ns) <= STAY_S


def _warning(memory: _Memory, now_ns: int) -> DriverWarning:
    finding = memory.finding
    left_s = None if finding.left_s is None else max(finding.left_s - s_from_ns(now_ns - memory.last_ns), 0.0)
    since_ns, ended = memory.since_ns[finding.level], memory.last_ns < now_ns
    return DriverWarning(
        finding.key, finding.level, finding.title, finding.detail, since_ns, left_s, finding.tracks, ended
    )


def _by_urgency(warning: DriverWarning) -> tuple[bool, int, float, int, str]:
    """Return a sort key: ended warnings last, then by level, time left, age."""
    return (
        warning.ended,
        -warning.level,
        math.inf if warning.left_s is None else warning.left_s,
        warning.since_ns,
        warning.key,
    )


def findings(facts: Facts) -> list[Finding]:
    """Return all conditions that hold; of several with one key the first that counts is meant."""
    return [finding for rule in RULES for finding in rule(facts)]


def _is_fresh(facts: Facts) -> bool:
    """Return whether a view came lately and shows what was measured lately."""
    if facts.frame_at_ns is None:
        return False
    return max(s_from_ns(facts.now_ns - facts.frame_at_ns), _view_age_s(facts)) <= _silent_s(facts)


def _view_age_s(facts: Facts) -> float:
    """Return the time since the last beam of the newest view; 0 where it is not known."""
    return 0.0 if facts.views is None or facts.views.age_ms is None else 1e-3 * facts.views.age_ms


def _silent_s(facts: Facts) -> float:
    """Return the duration that counts as silence: a few scans, if they are slow."""
    return max(SILENT_S, 3.0 * facts.scan_period_s)


def _vehicle_age_s(facts: Facts) -> float:
    return math.inf if facts.vehicle_at_ns is None else s_from_ns(facts.now_ns - facts.vehicle_at_ns)


# hidden road users


def hidden_objects(facts: Facts) -> Iterable[Finding]:
    """Return per side: crossing paths, then objects that enter sight, then moving ones; the most urgent first.

    A side, not a track, has the key: one vehicle that is tracked twice, or under a new id, is one warning.
    """
    frame = facts.frame
    if frame is None or not _is_fresh(facts):
        return
    count = Counter(side_of_track(track) for track in frame.tracks)
    tracks = sorted(frame.tracks, key=lambda track: math.hypot(track.x_m, track.y_m))[:MAX_TRACKS]
    crossings = _crossings(facts, tracks)
    # tracks refer to the scan's stamp, warnings to now
    has_age = on_one_clock(frame.stamp_ns, facts.now_ns, facts.graph_since_ns)
    late_s = s_from_ns(facts.now_ns - frame.stamp_ns) if has_age else 0.0
    ranked = [
        finding._replace(detail=finding.detail + _others(count[side_of_track(track)] - 1))
        for track, crossing in zip(tracks, crossings, strict=True)
        for finding in _about_track(track, crossing, late_s)
    ]
    yield from sorted(ranked, key=_by_precedence)
    if not frame.tracks:
        yield from _untracked(frame)


def _by_precedence(finding: Finding) -> tuple[int, bool, bool, float]:
    """Return a sort key: crossing paths precede objects that enter sight, even where they only keep a warning."""
    return (
        -finding.level,
        finding.kind != "meet",
        not finding.firm,
        math.inf if finding.left_s is None else finding.left_s,
    )


def _others(count: int) -> str:
    return f"; {count} more on this side" if count > 0 else ""


class Crossing(NamedTuple):
    """Two paths that approach: when they first do, the final distance, the standard deviation of the distance then."""

    time_s: float
    distance_m: float
    std_m: float


def _about_track(track: Track, crossing: Crossing | None, late_s: float) -> Iterable[Finding]:
    """Return the findings on one track; if one is not firm, also its replacement."""
    where, moves = place_words(track.x_m, track.y_m), is_moving(track)
    side, is_current = side_of_track(track), track.misses <= MAX_MISSES
    who = f"{'Hidden road user' if moves else 'Slow or standing hidden object'} {side_words(side)}"
    detail = f"{where}, {speed_words(track)}" if moves else where
    about = Finding(f"hidden/{side}", Level.NOTICE, who, detail, is_current, after_s=SETTLE_S, tracks=(track.id,))
    if crossing is not None:
        yield _meeting(about, crossing, late_s)
    if track.time_to_appear_s == 0.0:
        in_sight = f"now in direct sight, {where}"
        yield about._replace(kind="appear", level=Level.CAUTION, detail=in_sight, firm=False)
        return
    if track.time_to_appear_s is not None and track.time_to_appear_s - late_s <= APPEAR_UNTIL_S:
        left_s = max(track.time_to_appear_s - late_s, 0.0)
        yield about._replace(
            kind="appear",
            level=Level.URGENT if moves else Level.CAUTION,
            title=f"{who}: about to appear",
            firm=is_current and left_s <= APPEAR_S,
            left_s=left_s,
            after_s=0.0,
        )
    if moves:
        yield about


def _meeting(about: Finding, crossing: Crossing, late_s: float) -> Finding:
    """Return the finding of paths that approach each other, firm if near, certain and soon."""
    left_s = max(crossing.time_s - late_s, 0.0)
    apart = f"{crossing.distance_m:.1f} m (± {crossing.std_m:.1f} m) apart if both go on so"
    return about._replace(
        kind="meet",
        level=Level.URGENT,
        title=f"{about.title}: ways meet",
        detail=f"{apart}; {about.detail}",
        firm=about.firm and max(crossing.distance_m, crossing.std_m) <= CROSSING_M and left_s <= CROSSING_S,
        left_s=left_s,
        after_s=0.0,
    )


def _untracked(frame: BevFrame) -> Iterable[Finding]:
    """Return objects of a view without tracks: present, but with unknown motion."""
    for item in frame.objects:
        side = side_of(item.x_m, item.y_m)
        title = f"Hidden object {side_words(side)}"
        detail = f"{place_words(item.x_m, item.y_m)}; not followed, motion unknown"
        yield Finding(f"hidden/{side}", Level.NOTICE, title, detail, after_s=SETTLE_S)


def is_moving(track: Track) -> bool:
    """Return whether the speed of a track is significantly different from zero."""
    velocity = np.array([track.velocity_x_mps, track.velocity_y_mps])
    speed_mps = float(np.hypot(*velocity))
    if speed_mps <= MOVING_MPS:
        return False
    covariance = track.velocity_cov_m2ps2
    if covariance is None:
        return True
    return speed_mps > MOVING_SIGMAS * _std_along(velocity / speed_mps, np.array(covariance))


def _std_along(direction: np.ndarray, covariance: np.ndarray) -> float:
    """Return the standard deviation in a direction [2] by a covariance [2, 2]."""
    return math.sqrt(max(float(direction @ covariance @ direction), 0.0))


def _crossings(facts: Facts, tracks: Sequence[Track]) -> list[Crossing | None]:
    """Return where each track's path and the radar's first approach; None if they do not, or it is undetermined."""
    state = facts.vehicle
    if state is None or not (
        facts.vehicle is not None and facts.vehicle.valid and _vehicle_age_s(facts) <= VEHICLE_SILENT_S
    ):
        return [None] * len(tracks)
    count = round(CROSSING_UNTIL_S / CROSSING_STEP_S) + 1
    times_s = CROSSING_STEP_S * np.arange(count)
    radar_m = radar_ahead_m(state, facts.vehicle_from_radar, times_s)
    return [crossing_of(track, radar_m, times_s, CROSSING_UNTIL_M) for track in tracks]


def radar_ahead_m(state: VehicleState, vehicle_from_radar: Pose2, times_s: np.ndarray) -> np.ndarray:
    """Return positions [N, 2] of the radar in its own axes of now, if the vehicle keeps speed and yaw rate."""
    radar_from_vehicle = vehicle_from_radar.inverse()
    motions = (ego_motion(state.speed_mps, state.yaw_rate_rps, time_s) for time_s in times_s.tolist())
    poses = (radar_from_vehicle @ motion @ vehicle_from_radar for motion in motions)
    return np.array([[pose.x_m, pose.y_m] for pose in poses])


def crossing_of(track: Track, radar_m: np.ndarray, times_s: np.ndarray, near_m: float) -> Crossing | None:
    """Return the nearest approach of a track to the radar's path [N, 2] at `times_s` [N], and when it reaches `near_m`.

    None if it never does, if they move apart from the start, or if the velocity's covariance is unknown or leaves the
    distance less certain than `near_m`.
    """
    if track.velocity_cov_m2ps2 is None:
        return None
    start = np.array([track.x_m, track.y_m])
    offsets = start + times_s[:, None] * np.array([track.velocity_x_mps, track.velocity_y_mps]) - radar_m
    distances_m = np.hypot(offsets[:, 0], offsets[:, 1])
    first, nearest = int(np.argmax(distances_m <= near_m)), int(distances_m.argmin())
    if distances_m[nearest] > near_m or nearest == 0:
        return None
    spread = np.array(track.cov_m2) + times_s[first] ** 2 * np.array(track.velocity_cov_m2ps2)
    along = offsets[first] / max(distances_m[first], 1e-9)
    std_m = _std_along(along, spread)
    # too uncertain to decide
    if std_m > near_m:
        return None
    return Crossing(float(times_s[first]), float(distances_m[nearest]), std_m)


def side_of(x_m: float, y_m: float) -> str:
    """Return the side of a position: ahead, left, right, behind."""
    azimuth_deg = math.degrees(math.atan2(y_m, x_m))
    if abs(azimuth_deg) <= AHEAD_DEG:
        return "ahead"
    if abs(azimuth_deg) > 120.0:
        return "behind"
    return "left" if azimuth_deg > 0.0 else "right"


def side_of_track(track: Track) -> str:
    """Return the side of a track; for one straight ahead that crosses, the side it came from."""
    side = side_of(track.x_m, track.y_m)
    crosses = abs(track.velocity_y_mps) > max(abs(track.velocity_x_mps), MOVING_MPS)
    if side == "ahead" and crosses:
        return "left" if track.velocity_y_mps < 0.0 else "right"
    return side


def side_words(side: str) -> str:
    """Return "from the left", "ahead", "behind"."""
    return f"from the {side}" if side in ("left", "right") else side


def speed_words(track: Track) -> str:
    """Return the speed over ground: "14 km/h"."""
    return f"{3.6 * math.hypot(track.velocity_x_mps, track.velocity_y_mps):.0f} km/h"


def place_words(x_m: float, y_m: float) -> str:
    """Return distance and bearing: "18 m, 35° left"."""
    azimuth_deg = round(math.degrees(math.atan2(y_m, x_m)))
    bearing = "straight ahead" if azimuth_deg == 0 else f"{abs(azimuth_deg)}° {'left' if azimuth_deg > 0 else 'right'}"
    return f"{math.hypot(x_m, y_m):.0f} m, {bearing}"


# visibility


def silence(facts: Facts) -> Iterable[Finding]:
    """Return the absence of views for longer than a few scans: of a silent radar, or of a perception behind it."""
    if facts.frame_at_ns is None:
        waited_s = s_from_ns(facts.now_ns - facts.since_ns)
        if waited_s > _silent_s(facts):
            yield Finding("silent", Level.CAUTION, "No view yet", f"waiting for {waited_s:.0f} s")
    elif s_from_ns(facts.now_ns - facts.frame_at_ns) <= _silent_s(facts) < _view_age_s(facts):
        yield Finding("silent", Level.URGENT, "The view is old", f"measured {_view_age_s(facts):.0f} s ago")
    elif not _is_fresh(facts):
        quiet = f"no view for {s_from_ns(facts.now_ns - facts.frame_at_ns):.0f} s"
        yield Finding("silent", Level.URGENT, *_who_is_silent(facts, quiet))


def _who_is_silent(facts: Facts, quiet: str) -> tuple[str, str]:
    """Return title and detail of a silence; if no map ever came its source is undetermined."""
    if facts.map_at_ns is None:
        return "No view", quiet
    map_age_s = s_from_ns(facts.now_ns - facts.map_at_ns)
    if map_age_s > _silent_s(facts):
        return f"No view: the {facts.sensor} is silent", f"no scan for {map_age_s:.0f} s"
    return "No view: perception is silent", f"scans come, {quiet}"


def blindness(facts: Facts) -> Iterable[Finding]:
    """Return the finding that no mirror is observed: an empty view is then meaningless."""
    if facts.frame is None or not _is_fresh(facts):
        return
    cells = int(np.count_nonzero(facts.frame.visibility == Visibility.MIRRORED))
    area_m2 = cells * facts.frame.grid.cell_m**2
    if area_m2 >= BLIND_UNTIL_M2:
        return
    reason = "no wall found to look round with" if not facts.frame.walls else "no wall mirrors what is hidden"
    if facts.frame.walls and facts.sensor != "radar":
        reason = "what it would see of an object is not known"
    firm = area_m2 < BLIND_M2
    title = "Cannot see round corners"
    yield Finding("blind", Level.CAUTION, title, f"{reason}; an empty view means nothing", firm, after_s=SETTLE_S)


def conditions(facts: Facts) -> Iterable[Finding]:
    """Return the conditions that the scan reports."""
    if facts.frame is None or not _is_fresh(facts):
        return
    for flag in facts.frame.flags:
        title, detail = FLAG_WORDS.get(flag, (flag.replace("_", " ").capitalize(), "the scan says so of itself"))
        level = Level.NOTICE if flag in _HARMLESS_FLAGS else Level.CAUTION
        yield Finding(f"flag/{flag}", level, title, detail, after_s=SETTLE_S)


def own_motion(facts: Facts) -> Iterable[Finding]:
    """Return a missing vehicle state: without any the radar counts as stationary; after the last tracking stops."""
    age_s = _vehicle_age_s(facts)
    if facts.vehicle is None:
        if facts.frame is not None:
            so = f"the {facts.sensor} is taken as standing"
            yield Finding("vehicle", Level.NOTICE, "No vehicle state", so, after_s=SETTLE_S)
    elif age_s > VEHICLE_SILENT_S or not facts.vehicle.valid:
        reason = facts.vehicle.reason or "the vehicle state is not valid"
        why = f"no vehicle state for {age_s:.1f} s" if age_s > VEHICLE_SILENT_S else reason
        yield Finding("vehicle", Level.CAUTION, "Own motion unknown", f"{why}; hidden objects cannot be followed")


def lateness(facts: Facts) -> Iterable[Finding]:
    """Return views that are late or missing."""
    views = facts.views
    if views is None or views.misses + views.overdue == 0:
        return
    firm = views.misses + views.overdue >= LATE_VIEWS
    detail = f"{views.late} later than {views.deadline_s:g} s and {views.absent} missing in {views.window_s:.0f} s"
    yield Finding("late", Level.CAUTION, "Views come late", detail, firm)


def nodes(facts: Facts) -> Iterable[Finding]:
    """Return faulty parts of the graph, and the losses between them."""
    for node in facts.nodes:
        if node.state in ("degraded", "silent"):
            detail = node.reason or "it gives no reason"
            yield Finding(f"node/{node.node}", Level.CAUTION, f"{node.node} is {node.state}", detail)
        if node.lost > 0:
            detail = f"{counted(node.lost, 'message')} did not reach it lately"
            yield Finding(f"lost/{node.node}", Level.CAUTION, f"{node.node} loses messages", detail)


RULES: tuple[Callable[[Facts], Iterable[Finding]], ...] = (
    silence,
    hidden_objects,
    blindness,
    own_motion,
    conditions,
    lateness,
    nodes,
)


def warnings_json(warnings: Sequence[DriverWarning], now_ns: int) -> list[dict[str, Any]]:
    """Return warnings for a page, with their duration instead of their start."""
    return [
        {
            "key": warning.key,
            "level": warning.level.name.lower(),
            "title": warning.title,
            "detail": warning.detail,
            "left_s": None if warning.left_s is None else round(warning.left_s, 1),
            "age_s": round(s_from_ns(now_ns - warning.since_ns), 1),
            "tracks": list(warning.tracks),
            "ended": warning.ended,
        }
        for warning in warnings
    ]
