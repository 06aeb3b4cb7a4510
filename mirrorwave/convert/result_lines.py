"""The lines of `objects.jsonl` and `tracks.jsonl`: plain numbers, exact, so that equal views give equal bytes."""

from __future__ import annotations

import msgspec

from msgs.values.perception import BevFrame, Track


def bev_to_json(frame: BevFrame, axes: str = "radar") -> dict[str, object]:
    """Return the line of a view in `objects.jsonl`, in the `axes` of a radar, or of the vehicle."""
    return {
        "scan_id": frame.scan_id,
        "stamp_ns": frame.stamp_ns,
        "frame": axes,
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
                "id": hidden.id,
                "stamp_ns": hidden.stamp_ns,
                "x_m": hidden.x_m,
                "y_m": hidden.y_m,
                "centre_m": hidden.centre_m,
                "length_m": hidden.length_m,
                "width_m": hidden.width_m,
                "yaw_rad": hidden.yaw_rad,
                "score": hidden.score,
                "cov_m2": [list(row) for row in hidden.cov_m2],
                "object_class": hidden.object_class,
                "radial_speed": msgspec.to_builtins(hidden.radial_speed),
            }
            for hidden in frame.objects
        ],
    }


def track_to_json(track: Track) -> dict[str, object]:
    """Return a track as it stands in a line of `tracks.jsonl`."""
    return {name: getattr(track, name) for name in track.__struct_fields__}
