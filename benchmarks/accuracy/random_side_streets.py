"""Random drives past side streets: how early a hidden road user is tracked, against the most that its street allows.

Drives are those of `benchmarks.accuracy.side_street_scenes`: widths, corners, walls, parked vehicles, clutter, speeds,
braking and turns are drawn, and no drive is left out. Raw int16 beams of all effects that the simulator has (squint,
ground, diffraction, second mirrors, faults of the front end, ...; echoes in float32), odometry from states with noise
and a gyroscope's bias, the chain and the tracker as the graph runs them.

- Direct sight: the first scan at whose start the road user has a direct path.
- Most possible lead: from the first scan at whose start a mirror shows it with an echo over 10 dB of SNR in some beam
  (`VISIBLE_SNR_DB`) inside the map; 0 where none does before direct sight.
- Lead: from the first scan with a confirmed track within 2 m of it (face error, `models.evaluation.object_error`) to
  direct sight. Kept lead: from where one id stays on it in every scan up to direct sight, which is what
  `benchmarks.accuracy.side_street` calls lead. Both are 0 where there is no such track. Times are stamps of scans; a
  view comes 0.3 s after its scan's stamp, and the processing later.
- False track: a confirmed track that in most of its scans is farther than 2 m from every road user's outline; beside
  it tracks that stand on a road user in plain sight.
The share of the most possible lead is of sums over the drives, each lead counting up to what its street allows.

With --out, drives are written there as they are done; the same command goes on where it was stopped.
Usage: python -m benchmarks.accuracy.random_side_streets [--drives 48] [--seed 19] [--workers 1] [--chirps 128]
[--effects all]
       [--out FILE] [--figure FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.accuracy.side_street import GATE_M, Said, lead_s, params_of, switches
from benchmarks.accuracy.side_street_scenes import CROSSING, SideStreet, direct_sight, random_side_street
from benchmarks.perception.geometry_switches import machine
from mirrorwave.node_chain import SharedParts
from models.evaluation.frame_scores import Estimate, bootstrap_weights
from models.evaluation.metrics import match_objects
from models.evaluation.object_error import as_object, object_distances
from models.perception.forming.ra_former import RaFormer
from msgs.values.frames import Pose2
from msgs.values.perception import PathClass, SceneTruth, Track
from msgs.values.units import ns_from_s, s_from_ns
from msgs.values.vehicle import VehicleState
from sim_player.drive import Drive, DrivePlayer
from sim_player.trace.truth import labelled
from sim_player.trace.unthinned_truth import unthinned_paths

if TYPE_CHECKING:
    from matplotlib.axes import Axes

START_NS, REST_S, STATE_PERIOD_S = 10_000_000_000, 3.0, 0.02
SPEED_STD_MPS, YAW_RATE_STD_RPS, MAX_BIAS_RPS = 0.03, math.radians(0.2), math.radians(1.0)
#: No drive of the generator is longer.
MAX_SCANS = 40
#: Errors are looked at again this long after the first report.
LATER_S = 1.0
#: From the first to the second scan of a track: what confirmation takes at least.
CONFIRMATION_S = 0.3
DRAWS = 2000
#: Profile of each way, and whether it keeps walls over scans, as `launch/side_street.yaml` does.
WAYS = {
    "default": ("default", False),
    "default, walls kept": ("default", True),
    "clustered, walls kept": ("clustered", True),
    "cfar, walls kept": ("cfar", True),
}


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """What a track says of the crossing road user at a time [m, m/s]."""

    time_s: float
    face_error_m: float
    centre_error_m: float
    velocity_error_mps: float


class Tracked(msgspec.Struct, frozen=True, kw_only=True):
    """One way on one drive."""

    first: Report | None
    #: A second after the first report; None where it is in sight by then, or no track stands on it.
    later: Report | None
    #: Whether direct sight came less than a second after the first report.
    sight_before_later: bool
    lead_s: float
    kept_lead_s: float
    id_switches: int
    false_tracks: int
    plain_sight_tracks: int


class DriveResult(msgspec.Struct, frozen=True, kw_only=True):
    """One drive: what the street allows, and what each way made of it."""

    index: int
    layout: str
    manner: str
    object_class: str
    object_speed_mps: float
    ego_speed_mps: float
    sight_s: float
    #: Scans in which a mirror showed it before direct sight.
    image_scans: int
    most_possible_s: float
    ways: dict[str, Tracked]


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """What fixes a drive's result beside its index; first line of the file of results."""

    seed: int
    chirps: int
    effects: str
    ways: dict[str, dict[str, dict[str, object]]] = msgspec.field(
        default_factory=lambda: {name: params_of(way, wall_map=kept) for name, (way, kept) in WAYS.items()}
    )


@dataclass
class Observed:
    """What one way said of a drive, scan by scan while the crossing road user was out of direct sight."""

    crossing: list[Said] = field(default_factory=list)
    reports: list[Report | None] = field(default_factory=list)
    #: Of each id, per scan: on a road user (out of sight or not), on one in plain sight, on nothing.
    stands: dict[int, list[str]] = field(default_factory=dict)

    def add(self, tracks: Sequence[Track], truth: SceneTruth, time_s: float) -> None:
        """Take in the tracks of a scan; `truth` calls hidden all that have no direct path."""
        match = match_objects([as_object(track) for track in tracks], truth, GATE_M)
        hits = {track_id: truth_id for track_id, truth_id, _ in match.matched}
        mine = next((track for track in tracks if hits.get(track.id) == CROSSING), None)
        self.crossing.append(Said(time_s=time_s, id=None if mine is None else mine.id))
        self.reports.append(None if mine is None else _report(mine, match.matched, truth, time_s))
        for track in tracks:
            self.stands.setdefault(track.id, []).append("object" if track.id in hits else _stand(track, truth))

    def summary(self, sight_s: float) -> Tracked:
        """The drive in numbers."""
        first = next((report for report in self.reports if report is not None), None)
        kept = lead_s(self.crossing, sight_s)
        most = [max(set(stands), key=stands.count) for stands in self.stands.values()]
        later_s = math.inf if first is None else first.time_s + LATER_S
        later = next((report for report in zip_times(self.crossing, self.reports) if report[0] >= later_s - 1e-6), None)
        return Tracked(
            first=first,
            later=None if later is None else later[1],
            sight_before_later=first is not None and later is None,
            lead_s=0.0 if first is None else sight_s - first.time_s,
            kept_lead_s=0.0 if kept is None else kept,
            id_switches=switches(self.crossing),
            false_tracks=most.count("nothing"),
            plain_sight_tracks=most.count("plain sight"),
        )


def zip_times(said: Sequence[Said], reports: Sequence[Report | None]) -> list[tuple[float, Report | None]]:
    """Pair the times of scans with their reports."""
    return [(one.time_s, report) for one, report in zip(said, reports, strict=True)]


def _report(track: Track, matched: Sequence[tuple[int, int, float]], truth: SceneTruth, time_s: float) -> Report:
    """How far off a track is that stands on the crossing road user."""
    user = truth.objects[CROSSING]
    face_m = next(error_m for track_id, _, error_m in matched if track_id == track.id)
    off_mps = math.hypot(track.velocity_x_mps - user.velocity_x_mps, track.velocity_y_mps - user.velocity_y_mps)
    return Report(
        time_s=time_s,
        face_error_m=face_m,
        centre_error_m=float(object_distances([as_object(track)], truth, [user]).centre_m[0, 0]),
        velocity_error_mps=off_mps,
    )


def _stand(track: Track, truth: SceneTruth) -> str:
    """Where a track stands that is matched to no hidden road user."""
    away_m = object_distances([as_object(track)], truth, truth.objects).box_m[0]
    near = [user for user, box_m in zip(truth.objects, away_m, strict=True) if box_m <= GATE_M]
    if not near:
        return "nothing"
    return "object" if any(user.hidden for user in near) else "plain sight"


def states_of(drive: Drive, seed: Sequence[int]) -> list[VehicleState]:
    """Make what the bus says: 3 s at rest, then the drive; a constant bias of the yaw rate and white noise."""
    rng = np.random.default_rng([*seed, 21])
    bias_rps = float(rng.uniform(-MAX_BIAS_RPS, MAX_BIAS_RPS))
    states = []
    for time_s in np.arange(-REST_S, float(drive.time_s[-1]), STATE_PERIOD_S):
        drives = time_s >= -1e-9
        speed_mps = float(drive.speed_at(time_s)) + SPEED_STD_MPS * rng.standard_normal() if drives else 0.0
        yaw_rate_rps = float(drive.yaw_rate_at(time_s)) if drives else 0.0
        yaw_rate_rps += bias_rps + YAW_RATE_STD_RPS * rng.standard_normal()
        stamp_ns = START_NS + ns_from_s(float(time_s))
        states.append(VehicleState(stamp_ns=stamp_ns, speed_mps=speed_mps, yaw_rate_rps=yaw_rate_rps))
    return states


def hidden_truth(truth: SceneTruth, in_sight: frozenset[int]) -> SceneTruth:
    """The truth with every road user called hidden that has no direct path, whether a mirror shows it or not."""
    users = tuple(msgspec.structs.replace(user, hidden=user.id not in in_sight) for user in truth.objects)
    return msgspec.structs.replace(truth, objects=users)


def run_drive(settings: Settings, index: int) -> DriveResult:
    """Simulate and process one drive up to direct sight."""
    street = random_side_street(settings.seed, index)
    player = DrivePlayer(
        street.scene,
        street.drive,
        Pose2(),
        seed=settings.seed + index,
        start_ns=START_NS,
        chirps_per_beam=settings.chirps,
        effects=settings.effects,
        precision="float32",
    )
    with threadpool_limits(1):
        return _driven(settings, index, street, player)


def _driven(settings: Settings, index: int, street: SideStreet, player: DrivePlayer) -> DriveResult:
    # maps come from elsewhere, the same for all chains
    ways = {name: SharedParts.of(params, player.setup).chain() for name, params in settings.ways.items()}
    observed = {name: Observed() for name in ways}
    former, waiting = RaFormer(player.setup), states_of(street.drive, [settings.seed, index])
    images_s: list[float] = []
    for number in range(MAX_SCANS):
        time_s = s_from_ns(player.stamp_ns(number) - START_NS)
        paths = player.paths(time_s)
        if direct_sight(paths):
            break
        shown = unthinned_paths(player.setup, paths)
        if ((shown.kind == PathClass.MIRRORED) & (shown.object_index == CROSSING)).any():
            images_s.append(time_s)
        plain = paths.object_index[labelled(paths) & (paths.kind == PathClass.LOS)]
        truth = hidden_truth(player.truth(number), frozenset(plain.tolist()))
        states = [state for state in waiting if state.stamp_ns <= player.stamp_ns(number)]
        waiting = waiting[len(states) :]
        newest = states[-1]
        maps = [one for beam in range(len(player.setup.beams)) for one in former.add(player.beam(number, beam), newest)]
        for name, way in ways.items():
            for state in states:
                way.add_state(state)
            for ra_map in maps:
                observed[name].add(way.view(ra_map).frame.tracks, truth, time_s)
    user = street.scene.objects[CROSSING]
    return DriveResult(
        index=index,
        layout=street.layout,
        manner=street.manner,
        object_class=user.object_class,
        object_speed_mps=user.speed_mps,
        ego_speed_mps=float(street.drive.speed_mps[0]),
        sight_s=time_s,
        image_scans=len(images_s),
        most_possible_s=time_s - images_s[0] if images_s else 0.0,
        ways={name: one.summary(time_s) for name, one in observed.items()},
    )


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """One way over all drives; intervals are of a bootstrap over drives (95 %)."""

    way: str
    drives: int
    #: Drives whose street allows any lead, and those among all in which the road user was tracked before direct sight.
    possible: int
    found: Estimate
    kept: Estimate
    most_possible_mean_s: Estimate
    #: What is left of it where a track is confirmed by its second scan.
    confirmable_mean_s: Estimate
    lead_mean_s: Estimate
    kept_lead_mean_s: Estimate
    share_of_possible: Estimate
    kept_share_of_possible: Estimate
    id_switches: int
    false_tracks_per_min: Estimate
    plain_sight_tracks_per_min: Estimate
    #: Median and 90th percentile of face error, centre error [m] and velocity error [m/s], and how many there are.
    first: dict[str, tuple[float, float]]
    first_count: int
    later: dict[str, tuple[float, float]]
    later_count: int
    #: First reports whose track was gone a second later, and those after which direct sight came sooner.
    lost_later: int
    sight_before_later: int
    #: Of each layout: drives, mean of the most possible lead and of the kept one [s].
    layouts: dict[str, tuple[int, float, float]]


def summary_of(way: str, results: Sequence[DriveResult], seed: int) -> Summary:
    """Sum up one way."""
    weights = np.concatenate([np.ones((1, len(results))), bootstrap_weights(len(results), DRAWS, seed)])
    tracked = [result.ways[way] for result in results]
    possible_s = np.array([result.most_possible_s for result in results])
    duration_min = np.array([result.sight_s for result in results]) / 60.0
    every = np.ones(len(results))

    def mean(values: Sequence[float], over: np.ndarray = every) -> Estimate:
        return _estimate(weights @ np.asarray(values, np.float64), weights @ over)

    leads_s, kept_s = np.array([one.lead_s for one in tracked]), np.array([one.kept_lead_s for one in tracked])
    firsts = [one.first for one in tracked if one.first is not None]
    laters = [one.later for one in tracked if one.later is not None]
    return Summary(
        way=way,
        drives=len(results),
        possible=int((possible_s > 0.0).sum()),
        found=mean(leads_s > 0.0),
        kept=mean(kept_s > 0.0),
        most_possible_mean_s=mean(possible_s),
        confirmable_mean_s=mean(np.maximum(possible_s - CONFIRMATION_S, 0.0)),
        lead_mean_s=mean(leads_s),
        kept_lead_mean_s=mean(kept_s),
        share_of_possible=mean(np.minimum(leads_s, possible_s), possible_s),
        kept_share_of_possible=mean(np.minimum(kept_s, possible_s), possible_s),
        id_switches=sum(one.id_switches for one in tracked),
        false_tracks_per_min=mean([one.false_tracks for one in tracked], duration_min),
        plain_sight_tracks_per_min=mean([one.plain_sight_tracks for one in tracked], duration_min),
        first=_quantiles(firsts),
        first_count=len(firsts),
        later=_quantiles(laters),
        later_count=len(laters),
        lost_later=len(firsts) - len(laters) - sum(one.sight_before_later for one in tracked),
        sight_before_later=sum(one.sight_before_later for one in tracked),
        layouts=_by_layout(way, results),
    )


def _by_layout(way: str, results: Sequence[DriveResult]) -> dict[str, tuple[int, float, float]]:
    """Drives, mean of the most possible lead and of the kept one, layout by layout."""
    groups = {one.layout: [each for each in results if each.layout == one.layout] for one in results}
    return {
        layout: (
            len(group),
            float(np.mean([one.most_possible_s for one in group])),
            float(np.mean([one.ways[way].kept_lead_s for one in group])),
        )
        for layout, group in sorted(groups.items())
    }


def _estimate(above: np.ndarray, below: np.ndarray) -> Estimate:
    """A ratio with its percentile interval; the first row is the value, the others are draws."""
    ratio = np.divide(above, below, out=np.full(len(above), np.nan), where=below > 0.0)
    drawn = ratio[1:][np.isfinite(ratio[1:])]
    low, high = np.percentile(drawn, (2.5, 97.5)) if len(drawn) else (math.nan, math.nan)
    return Estimate(float(ratio[0]), float(low), float(high))


def _quantiles(reports: Sequence[Report]) -> dict[str, tuple[float, float]]:
    """Median and 90th percentile of each error; nothing without reports."""
    if not reports:
        return {}
    names = ("face_error_m", "centre_error_m", "velocity_error_mps")
    columns = {name: np.percentile([getattr(one, name) for one in reports], (50.0, 90.0)) for name in names}
    return {name: (float(middle), float(high)) for name, (middle, high) in columns.items()}


def results_of(settings: Settings, drives: int, workers: int, out: Path | None) -> list[DriveResult]:
    """All drives in order, those of a file of results taken from there; the same whatever the number of workers."""
    done = {} if out is None else _read(settings, out)
    if out is not None and not out.exists():
        _append(out, settings)
    missing = [index for index in range(drives) if index not in done]
    for result in _run(settings, missing, workers):
        done[result.index] = result
        if out is not None:
            _append(out, result)
        best = max(one.kept_lead_s for one in result.ways.values())
        sys.stderr.write(
            f"{len(done)} of {drives}: drive {result.index}, sight {result.sight_s:.1f} s, possible "
            f"{result.most_possible_s:.1f} s, best {best:.1f} s\n"
        )
    return [done[index] for index in range(drives)]


def _run(settings: Settings, indices: Sequence[int], workers: int) -> Iterator[DriveResult]:
    if workers == 1:
        yield from (run_drive(settings, index) for index in indices)
        return
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        yield from pool.imap_unordered(_run_one, [(settings, index) for index in indices])


def _run_one(task: tuple[Settings, int]) -> DriveResult:
    return run_drive(*task)


def _append(out: Path, value: Settings | DriveResult) -> None:
    """One line more; written at once, so that a run that is stopped loses the drive under way alone."""
    with out.open("ab") as file:
        file.write(msgspec.json.encode(value) + b"\n")


def _read(settings: Settings, out: Path) -> dict[int, DriveResult]:
    """Results so far; ValueError naming the file where it was made with other settings. A cut last line is dropped."""
    if not out.exists():
        return {}
    text = out.read_bytes()
    lines = text[: text.rfind(b"\n") + 1].splitlines()
    out.write_bytes(b"".join(line + b"\n" for line in lines))
    if not lines or msgspec.json.decode(lines[0], type=Settings) != settings:
        raise ValueError(f"{out}: made with other settings; name another file, or remove it")
    return {one.index: one for one in (msgspec.json.decode(line, type=DriveResult) for line in lines[1:])}


def draw_figure(results: Sequence[DriveResult], path: Path) -> None:
    """Draw the kept lead over the most possible lead of every drive, one panel a way."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = list(results[0].ways)
    figure, grid = pyplot.subplots(
        1, len(names), figsize=(4.2 * len(names), 4.7), layout="constrained", sharey=True, squeeze=False
    )
    for axes, name in zip(grid[0], names, strict=True):
        _draw_way(axes, name, results)
    grid[0, 0].set_ylabel("lead up to direct sight, s")
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 2 * len(names)))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, metadata={"Software": None} if path.suffix == ".png" else None)
    pyplot.close(figure)


def _draw_way(axes: Axes, name: str, results: Sequence[DriveResult]) -> None:
    """Draw the drives of one way; leads are multiples of 0.3 s, so a marker's area says how many stand in one place."""
    possible_s = np.array([result.most_possible_s for result in results])
    first_s = np.array([result.ways[name].lead_s for result in results])
    kept_s = np.array([result.ways[name].kept_lead_s for result in results])
    end_s = 1.05 * max(possible_s.max(), 1.0)
    found, kept = first_s > 0.0, kept_s > 0.0
    axes.plot([0.0, end_s], [0.0, end_s], "k--", linewidth=1.0, label="the most possible")
    for which, values, style in (
        (kept, kept_s, {"marker": "o", "color": "tab:blue", "label": "tracked up to direct sight"}),
        (found & ~kept, first_s, {"marker": "^", "color": "tab:orange", "label": "tracked, lost before direct sight"}),
        (~found, first_s, {"marker": "x", "color": "tab:red", "label": "not found: 0 s"}),
    ):
        spots, count = _counted(possible_s[which], values[which])
        label = style.pop("label")
        axes.scatter(*spots.T, s=22.0 * count, zorder=3, clip_on=False, alpha=0.8, **style)
        # for the legend, in one size
        axes.scatter([], [], s=40.0, label=label, **style)
        for (x_s, y_s), number in zip(spots, count, strict=True):
            if number > 1:
                axes.annotate(str(number), (x_s, y_s), (0, 8), textcoords="offset points", fontsize=8, ha="center")
    axes.set(title=name, xlabel="most possible lead, s", xlim=(0.0, end_s), ylim=(0.0, end_s))
    axes.title.set_fontsize(10)
    axes.grid(alpha=0.3)


def _counted(x_s: np.ndarray, y_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct points [N, 2] to a tenth of a second, and how often each is there [N]."""
    pairs = np.round(np.column_stack([x_s, y_s]), 1) + 0.0
    spots, count = np.unique(pairs, axis=0, return_counts=True)
    return spots.reshape(-1, 2), count


def lines_of(one: Summary) -> list[str]:
    """One way in words."""

    def errors(found: dict[str, tuple[float, float]], count: int) -> str:
        if not found:
            return "none"
        face, centre, velocity = (
            "{:.2f} ({:.2f})".format(*found[name]) for name in ("face_error_m", "centre_error_m", "velocity_error_mps")
        )
        return f"{count} reports: face {face} m, centre {centre} m, velocity {velocity} m/s, median (90th percentile)"

    return [
        f"{one.way}: {one.drives} drives, {one.possible} with a lead possible",
        f"  tracked before direct sight {one.found}, up to it {one.kept}",
        f"  mean lead {one.lead_mean_s} s, kept {one.kept_lead_mean_s} s, most possible {one.most_possible_mean_s} s, "
        f"of which confirmation leaves {one.confirmable_mean_s} s",
        f"  share of the most possible {one.share_of_possible}, kept {one.kept_share_of_possible}",
        f"  id switches {one.id_switches}, false tracks {one.false_tracks_per_min} a minute, "
        f"on road users in plain sight {one.plain_sight_tracks_per_min} a minute",
        f"  at first: {errors(one.first, one.first_count)}",
        f"  1 s later: {errors(one.later, one.later_count)}; {one.lost_later} lost by then, "
        f"{one.sight_before_later} in sight by then",
        "  "
        + "; ".join(
            f"{layout}: {count} drives, possible {possible_s:.2f} s, kept {kept_s:.2f} s"
            for layout, (count, possible_s, kept_s) in one.layouts.items()
        ),
    ]


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=48)
    parser.add_argument("--seed", type=int, default=19)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--chirps", type=int, default=128)
    parser.add_argument("--effects", default="all", help="basic, all, or names with commas between them")
    parser.add_argument("--out", type=Path, help="results drive by drive; a run that was stopped goes on from there")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if min(arguments.drives, arguments.workers, arguments.chirps) < 1 or arguments.seed < 0:
        parser.error("--drives, --workers and --chirps must be 1 at least, --seed 0 at least")
    return arguments


def main() -> int:
    arguments = read_arguments()
    settings = Settings(seed=arguments.seed, chirps=arguments.chirps, effects=arguments.effects)
    try:
        results = results_of(settings, arguments.drives, arguments.workers, arguments.out)
    except (OSError, ValueError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    summaries = [summary_of(way, results, arguments.seed) for way in settings.ways]
    if arguments.figure:
        draw_figure(results, arguments.figure)
    command = "python -m benchmarks.accuracy.random_side_streets " + " ".join(sys.argv[1:])
    if arguments.json:
        found = {"settings": settings, "summaries": summaries, "drives": results}
        print(json.dumps({"machine": machine(), "command": command, **msgspec.to_builtins(found)}))
        return 0
    print("\n".join([*(text for one in summaries for text in lines_of(one)), command, machine()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
