"""Tracking of hidden objects over scans in an odometry frame: existence, not hits.

A joint integrated probabilistic data association filter: a scan begins hypotheses, and raises or lowers the existence
of all. A track is published once that is high; ids are never used twice. No library:
Stone Soup would bring six more to the vehicle, FilterPy has no tracks, gates or assignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import msgspec
import numpy as np

from models.perception.track.appearance import Outlook, RecentWalls, radar_ahead
from models.perception.track.bernoulli import MAX_EXISTENCE, Bernoulli, born, is_same, log_odds_of_pairs, updated
from models.perception.track.estimate import Estimate
from models.perception.track.joint_association import log_likelihoods, marginal_probabilities
from models.perception.track.measurements import Sighting, detection_probabilities, rotation, sightings
from models.perception.track.odometry import OdometryPose, odom_from_radar_after
from msgs.values.arrays import Covariance, require_positive, require_within
from msgs.values.frames import Pose2
from msgs.values.perception import BevFrame, Track
from msgs.values.units import ns_from_s, s_from_ns

#: A radar at the reference point of the vehicle's motion.
FRONT = Pose2()
#: Largest number of hypotheses that are kept, the likeliest: no street hides as many.
MAX_TRACKS = 200
#: A published position is known to this standard deviation along its worst axis: a vaguer one points at nothing.
MAX_POSITION_STD_M = 2.0
#: A measurement counts as a track's where it is so probable.
LIKELY = 0.5
#: Where views share beams, an object that is not measured again within so many sweeps was missed: it may have moved on
#: in azimuth, and what lies in the newest beams is not whole yet.
SWEEPS_UNTIL_MISSED = 1.15


#: Probability that an object still exists, and hides, a second later.
SURVIVAL_PER_S = 0.8
#: A track ends below this existence.
LEAST_EXISTENCE = 0.05
#: All tracks are deleted where no scan arrived for longer, or the clock went back by more.
MAX_GAP_S = 2.0


class TrackParams(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Tracks that are published."""

    #: A track is published from this existence on. IDF1, HOTA and GOSPA of `validation_drives` chose it together with
    #: `detection_probability`.
    confirm_existence: float = 0.8

    def __post_init__(self) -> None:
        require_within("tracker.confirm_existence", LEAST_EXISTENCE, 1.0, self.confirm_existence)


class TrackerParams(TrackParams, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Motion and measurement model and birth of objects, as far as what is tracked differs in them."""

    #: Spectral density of the white acceleration: after 1 s the velocity has this variance more.
    acceleration_density_m2ps3: float = 2.0
    #: Standard deviation of the velocity of an object detected once, along each axis.
    first_speed_std_mps: float = 8.0
    #: Added to each object's own: the centre of the visible part of a vehicle wanders over its face.
    place_std_m: float = 0.4
    #: Probability that a scan reports an object that stands where its observability mask says it can.
    detection_probability: float = 0.7
    #: Density of the reports of a scan that are new objects; with their scores it gives that of false reports.
    birth_density_per_m2: float = 3e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.__struct_fields__:
            require_positive(f"tracker.{name}", getattr(self, name))
        require_within("tracker.detection_probability", 0.0, MAX_EXISTENCE, self.detection_probability)
        require_within("tracker.birth_density_per_m2", 1e-12, 1.0, self.birth_density_per_m2)


@dataclass
class _TrackState:
    """State of one track."""

    id: int
    first_ns: int
    bernoulli: Bernoulli
    #: Scans whose likeliest event has a measurement of it, and scans since the last of them.
    measurements: int = 1
    misses: int = 0
    #: A wall hid it at some time: only then can it come into sight.
    was_blocked: bool = False
    #: Where views share beams: when its last measurement was taken, and time up to which it was measured or missed.
    measured_ns: int = 0
    looked_ns: int = 0

    @property
    def estimate(self) -> Estimate:
        """Where it is if it exists."""
        return self.bernoulli.estimate


@dataclass
class Tracker:
    """Tracker of the hidden objects of one radar; one call a scan, in the order of their stamps."""

    params: TrackerParams = field(default_factory=TrackerParams)
    _tracks: list[_TrackState] = field(default_factory=list, init=False)
    _walls: RecentWalls = field(default_factory=RecentWalls, init=False)
    _next_id: int = field(default=1, init=False)
    _last_ns: int | None = field(default=None, init=False)
    _frame: int | None = field(default=None, init=False)
    _messages: tuple[Track, ...] = field(default=(), init=False)

    def step(
        self,
        frame: BevFrame,
        pose: OdometryPose | None,
        vehicle_from_radar: Pose2 = FRONT,
        ego_compensated: bool = True,
    ) -> tuple[Track, ...]:
        """Return the confirmed tracks after a scan, in the radar's axes and at the time of that scan's stamp, by id.

        `pose`: the vehicle then; without it, or in another frame, all tracks end. A repeated or late scan changes
        nothing. Objects of a scan that was not `ego_compensated` lie where the radar saw them at their own stamps.
        """
        if pose is None:
            self._forget(None)
            return ()
        if self._is_late(frame.stamp_ns):
            return self._messages
        is_gap = self._last_ns is not None and abs(frame.stamp_ns - self._last_ns) > ns_from_s(MAX_GAP_S)
        if pose.frame != self._frame or is_gap:
            self._forget(pose.frame)
        odom_from_radar = pose.odom_from_vehicle @ vehicle_from_radar
        radar = odom_from_radar if ego_compensated else partial(odom_from_radar_after, pose, vehicle_from_radar)
        self._follow(frame, odom_from_radar, sightings(frame, radar, self.params.place_std_m))
        self._last_ns = frame.stamp_ns
        a, b = self._walls.add(frame.stamp_ns, frame.walls, odom_from_radar)
        confirmed = self._confirmed()
        # an outlook takes as long as all the rest
        radar_m = radar_ahead(pose, vehicle_from_radar) if confirmed else np.zeros((0, 2))
        outlook = Outlook(radar_m, a, b)
        messages = (self._to_message(track, frame.stamp_ns, odom_from_radar, outlook) for track in confirmed)
        self._messages = tuple(message for message in messages if _position_std_m(message) <= MAX_POSITION_STD_M)
        return self._messages

    def _is_late(self, stamp_ns: int) -> bool:
        if self._last_ns is None:
            return False
        return 0 <= self._last_ns - stamp_ns <= ns_from_s(MAX_GAP_S)

    def _forget(self, frame: int | None) -> None:
        """End all tracks; the next id stays."""
        self._tracks, self._last_ns, self._frame, self._messages = [], None, frame, ()
        self._walls.clear()

    def _confirmed(self) -> list[_TrackState]:
        return [track for track in self._tracks if track.bernoulli.existence >= self.params.confirm_existence]

    def _follow(self, frame: BevFrame, odom_from_radar: Pose2, reported: list[Sighting]) -> None:
        """Predict, associate, update, begin and end tracks by what a scan has `reported`."""
        params, stamp_ns = self.params, frame.stamp_ns
        elapsed_s = 0.0 if self._last_ns is None else s_from_ns(stamp_ns - self._last_ns)
        for track in self._tracks:
            track.bernoulli = track.bernoulli.survived(elapsed_s, SURVIVAL_PER_S)
        measurements = self._new(reported, frame)
        now = [track.estimate.at(stamp_ns, params.acceleration_density_m2ps3) for track in self._tracks]
        detection = detection_probabilities(frame, now, odom_from_radar, params.detection_probability)
        likelihood = self._log_likelihoods(measurements)
        is_looked_at = self._looked_at(frame, likelihood)
        # what no beam has looked at was not missed
        detection = np.where(is_looked_at, detection, 0.0)
        probability = self._associated(detection, likelihood, measurements)
        for track, detected, share in zip(self._tracks, detection.tolist(), probability, strict=True):
            track.bernoulli = updated(
                track.bernoulli, detected, share, measurements, stamp_ns, params.acceleration_density_m2ps3
            )
            if detected > 0.0 or frame.settled_stamp_ns is None:
                self._count(track, share, measurements, frame.settled_stamp_ns or 0)
        self._begin(measurements, probability.sum(axis=0))
        self._tracks = self._kept()

    def _new(self, measurements: list[Sighting], frame: BevFrame) -> list[Sighting]:
        """Return the measurements that no track has had from an earlier view of the same beams, whole ones alone."""
        if frame.settled_stamp_ns is None:
            return measurements
        settled = [sighting for sighting in measurements if sighting.stamp_ns <= frame.settled_stamp_ns]
        sweep_ns = frame.settled_stamp_ns - frame.stamp_ns
        is_near = np.isfinite(self._log_likelihoods(settled))
        return [
            sighting
            for sighting, near in zip(settled, is_near.T, strict=True)
            if not any(
                is_candidate and abs(sighting.stamp_ns - track.measured_ns) < sweep_ns // 2
                for track, is_candidate in zip(self._tracks, near, strict=True)
            )
        ]

    def _looked_at(self, frame: BevFrame, log_likelihood: np.ndarray) -> np.ndarray:
        """Return whether a view's new beams, or a sweep, may have shown each track, bool [T]; a whole scan does."""
        if frame.settled_stamp_ns is None:
            return np.ones(len(self._tracks), np.bool_)
        sweep_ns = SWEEPS_UNTIL_MISSED * (frame.settled_stamp_ns - frame.stamp_ns)
        is_due = [frame.settled_stamp_ns - track.looked_ns >= sweep_ns for track in self._tracks]
        return np.asarray(np.isfinite(log_likelihood).any(axis=1) | np.array(is_due, np.bool_))

    @staticmethod
    def _count(track: _TrackState, share: np.ndarray, measurements: Sequence[Sighting], looked_ns: int) -> None:
        """Count a view that looked where a track is; `share` [M] is the probability of each measurement to be its."""
        is_hit = bool(share.sum() >= LIKELY)
        track.measurements, track.misses = track.measurements + is_hit, 0 if is_hit else track.misses + 1
        track.looked_ns = looked_ns
        if is_hit:
            track.measured_ns = measurements[int(share.argmax())].stamp_ns

    def _log_likelihoods(self, measurements: Sequence[Sighting]) -> np.ndarray:
        """Return the logarithm of the density [T, M] of each measurement by each track."""
        estimates = [track.estimate for track in self._tracks]
        return log_likelihoods(estimates, measurements, self.params.acceleration_density_m2ps3)

    def _associated(
        self, detection: np.ndarray, log_likelihood: np.ndarray, measurements: Sequence[Sighting]
    ) -> np.ndarray:
        """Return the probability [T, M] of each pair of a track and a measurement."""
        existence = np.array([track.bernoulli.existence for track in self._tracks])
        # of reports of nothing known, the share of new objects is the score
        background = np.array([self.params.birth_density_per_m2 / sighting.score for sighting in measurements])
        return marginal_probabilities(log_odds_of_pairs(existence, detection, log_likelihood, background))

    def _begin(self, measurements: Sequence[Sighting], explained: np.ndarray) -> None:
        """Begin a track of each measurement, with the existence that is left to explain."""
        for sighting, share in zip(measurements, explained.tolist(), strict=True):
            bernoulli = born(sighting, share, self.params.first_speed_std_mps)
            if bernoulli.existence >= LEAST_EXISTENCE:
                begun_ns = sighting.stamp_ns
                self._tracks.append(
                    _TrackState(self._next_id, begun_ns, bernoulli, measured_ns=begun_ns, looked_ns=begun_ns)
                )
                self._next_id += 1

    def _kept(self) -> list[_TrackState]:
        """Return the tracks that may exist, by id; of too many the likeliest, of two on one object the better known."""
        kept = [track for track in self._tracks if track.bernoulli.existence >= LEAST_EXISTENCE]
        kept = sorted(kept, key=lambda track: (-track.bernoulli.existence, track.id))[:MAX_TRACKS]
        distinct: list[_TrackState] = []
        for track in sorted(kept, key=lambda track: (-track.measurements, track.id)):
            same = next((other for other in distinct if self._is_same(track, other)), None)
            if same is None:
                distinct.append(track)
            elif track.bernoulli.existence > same.bernoulli.existence:
                # both rest on the same reports: their chances do not add up
                same.bernoulli = replace(same.bernoulli, existence=track.bernoulli.existence)
        return sorted(distinct, key=lambda track: track.id)

    def _is_same(self, first: _TrackState, second: _TrackState) -> bool:
        return is_same(first.estimate, second.estimate, self.params.acceleration_density_m2ps3)

    def _to_message(self, track: _TrackState, stamp_ns: int, odom_from_radar: Pose2, outlook: Outlook) -> Track:
        """Return the message of a track."""
        now = track.estimate.at(stamp_ns, self.params.acceleration_density_m2ps3)
        hidden = outlook.hidden(now.mean)
        track.was_blocked |= bool(hidden[0])
        radar_from_odom = odom_from_radar.inverse()
        at_m, velocity = radar_from_odom.apply(now.mean[:2]), radar_from_odom.rotate(now.mean[2:])
        return Track(
            id=track.id,
            x_m=float(at_m[0]),
            y_m=float(at_m[1]),
            velocity_x_mps=float(velocity[0]),
            velocity_y_mps=float(velocity[1]),
            age_s=max(s_from_ns(stamp_ns - track.first_ns), 0.0),
            cov_m2=_rotated(now.covariance[:2, :2], radar_from_odom),
            velocity_cov_m2ps2=_rotated(now.covariance[2:, 2:], radar_from_odom),
            misses=track.misses,
            time_to_appear_s=outlook.time_to_appear_s(hidden) if track.was_blocked else None,
            existence=float(track.bernoulli.existence),
            object_class=track.bernoulli.object_class,
        )


def _position_std_m(track: Track) -> float:
    """Return the standard deviation of a position along its worst axis."""
    return float(np.sqrt(np.linalg.eigvalsh(np.array(track.cov_m2))[-1]))


def _rotated(covariance: np.ndarray, pose: Pose2) -> Covariance:
    """Return a covariance rotated into the axes of a pose."""
    turn = rotation(pose)
    (xx, xy), (_, yy) = (turn @ covariance @ turn.T).tolist()
    return (xx, xy), (xy, yy)
