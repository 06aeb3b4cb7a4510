"""First meeting of a radar with a wall or an object, where one moves: beyond it no map of the scene means anything."""

from __future__ import annotations

import math

import numpy as np

from msgs.values.vehicle import ego_motion
from sim_player.scene.description import FARTHEST_M, Scene, wall_pieces

#: Chords of the circle of a radar that turns: each deviates from it by under 1e-5 of its radius.
_CHORDS = 720


def first_meeting(scene: Scene, time_s: np.ndarray, position_m: np.ndarray) -> tuple[float, str] | None:
    """Return when straight lines between positions [N, 2] meet the first wall or object, in words which; None: none.

    A mesh, which may have a yard, is not met.
    """
    if len(time_s) < 2:
        return None
    owner, a, b = wall_pieces(scene.surfaces)
    met = []
    if len(owner):
        met_s, piece = _crossing(time_s, position_m, a, b)
        met.append((met_s, f"the radar drives into the wall surfaces[{owner[piece]}]"))
    for index, each in enumerate(scene.objects):
        if not each.mesh:
            yaw_rad, corners = math.radians(each.yaw_deg), each.corners_m()
            moved_m = each.speed_mps * time_s[:, None] * np.array([math.cos(yaw_rad), math.sin(yaw_rad)])
            met_s, _ = _crossing(time_s, position_m - moved_m, corners, np.roll(corners, -1, axis=0))
            met.append((met_s, f"the radar and objects[{index}] ({each.object_class}) meet"))
    first = min(met, default=(math.inf, ""))
    return first if math.isfinite(first[0]) else None


def _crossing(time_s: np.ndarray, position_m: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[float, int]:
    """Return when straight lines between positions [N, 2] cross the first piece from a to b [M, 2], and which."""
    start, step, wall = position_m[:-1, None], np.diff(position_m, axis=0)[:, None], b - a
    turn = step[..., 0] * wall[:, 1] - step[..., 1] * wall[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along_step = ((a - start)[..., 0] * wall[:, 1] - (a - start)[..., 1] * wall[:, 0]) / turn
        along_wall = ((a - start)[..., 0] * step[..., 1] - (a - start)[..., 1] * step[..., 0]) / turn
        meets = (along_step >= 0.0) & (along_step <= 1.0) & (along_wall >= 0.0) & (along_wall <= 1.0)
        met_s = np.where(meets, time_s[:-1, None] + along_step * np.diff(time_s)[:, None], math.inf)
    first = np.unravel_index(int(np.argmin(met_s)), met_s.shape)
    return float(met_s[first]), int(first[1])


def ego_meeting(scene: Scene) -> tuple[float, str] | None:
    """Return when the radar of a scene, or one of several, meets the first wall or object, in words which; or None."""
    if scene.radars:
        meetings = (ego_meeting(scene.of_radar(name)) for name in scene.radars)
        return min((meeting for meeting in meetings if meeting is not None), default=None)
    speed_mps, yaw_rate_rps = scene.ego.speed_mps, math.radians(scene.ego.yaw_rate_dps)
    fastest_mps = max(abs(speed_mps), *(abs(each.speed_mps) for each in scene.objects), 0.0)
    if not fastest_mps:
        return None
    straight_s = 4.0 * FARTHEST_M / fastest_mps
    # after a whole circle it drives where it drove, as far as objects are at rest
    period_s = 2.0 * math.pi / abs(yaw_rate_rps) if yaw_rate_rps and speed_mps else math.inf
    time_s = np.linspace(0.0, min(period_s, straight_s), _CHORDS + 1 if period_s < straight_s else 2)
    mounted = scene.radar.mounting.vehicle_from_radar
    poses = [ego_motion(speed_mps, yaw_rate_rps, float(at_s)) @ mounted for at_s in time_s]
    return first_meeting(scene, time_s, np.array([(pose.x_m, pose.y_m) for pose in poses]))


def meeting_text(meeting: tuple[float, str]) -> str:
    """Return in words when a radar meets what."""
    return f"{meeting[1]} after {meeting[0]:.2f} s"


def require_unmet(scene: Scene, meeting: tuple[float, str] | None, time_s: float) -> None:
    """Raise `ValueError` for a time after the meeting of the radar with a wall or an object, if there is one."""
    if meeting is not None and time_s > meeting[0]:
        raise ValueError(f"scene {scene.name!r}: {meeting_text(meeting)}, asked for {time_s:.2f} s")


def require_clear_path(scene: Scene, duration_s: float) -> None:
    """Raise `ValueError`, field first, where the radar of a scene meets a wall or an object within a duration."""
    meeting = ego_meeting(scene)
    if meeting is not None and meeting[0] <= duration_s:
        speed_mps = scene.ego.speed_mps
        field, got = ("ego.speed_mps", f", got {speed_mps!r}") if speed_mps else ("objects", "")
        raise ValueError(f"{field}: {meeting_text(meeting)}, within the {duration_s:g} s of the recording{got}")
