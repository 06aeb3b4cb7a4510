"""The lines of `objects.jsonl` and `tracks.jsonl`: plain numbers, exact, so that equal views give equal bytes."""

from __future__ import annotations

from msgs.values.perception import BevFrame, Track


def bev_to_json(frame: BevFrame) -> dict[str, object]:
    """Return the line of a view in `objects.jsonl`."""
    return {
        "scan_id": frame.scan_id,
        "stamp_ns": frame.stamp_ns,
        "frame": "radar",
        "walls": [
            {
                "normal": list(wall.normal),
                "offset_m": wall.offset_m,
                "ends_m": [list(end) for end in wall.ends_m],
                "inliers": wall.inliers,
            }
            for wall in frame.walls
        ],
        "points": [{"x_m": point.x_m, "y_m": point.y_m, "score": point.score} for point in frame.points],
        "objects": [
            {
                "id": one.id,
                "x_m": one.x_m,
                "y_m": one.y_m,
                "length_m": one.length_m,
                "width_m": one.width_m,
                "yaw_rad": one.yaw_rad,
                "score": one.score,
                "cov_m2": [list(row) for row in one.cov_m2],
            }
            for one in frame.objects
        ],
    }


def track_to_json(track: Track) -> dict[str, object]:
    """Return a track as it stands in a line of `tracks.jsonl`."""
    return {name: getattr(track, name) for name in track.__struct_fields__}
