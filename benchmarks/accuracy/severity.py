"""The six scenes under faults of growing severity: hidden vehicles found, missed, made up; what the view flags.

Faults act where they arise (array weights, receiver, converter, link); the chain knows only the radar's set-up. Draws
of a scene and seed are the same at every severity, only scaled. Each case leaves a small file; cases that are there
already are not run again. Usage: python -m benchmarks.accuracy.severity [--faults NAME ...] [--scenes NAME ...]
[--seeds 5]
       [--seed 0] [--work runs/severity] [--figure FILE] [--table FILE] [--json]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks.accuracy.six_scenes import SCENES
from lab.measures.point_scores import Counts, recovered_counts
from mirrorwave.plots.style import handles_of, legend_of_figure, new_figure, save
from models.perception.chain import Chain
from models.perception.find.detectors import NetworkDetector
from models.perception.find.maps_to_peaks import DetectionStage
from models.perception.form.beams_to_maps import FormingStage
from models.perception.track.views_over_scans import ViewStage
from models.physics.antenna import setup_weights
from models.physics.waveform import window_noise_gain
from models.scores.object_matching import match_objects
from msgs.values.perception import BevFrame, SceneTruth
from msgs.values.radar import FULL_SCALE_CODE, RadarBeam, RadarSetup
from msgs.values.units import db_from_ratio, ratio_from_db
from sim_player.dataset.labelled_scan import BASIC_USED
from sim_player.player import ScenePlayer
from sim_player.scene.description import Scene, load_scene
from sim_player.scene.front_end import FrontEnd, Spur

#: Gains of the eight elements of two measured 10 GHz boards (calibration files of public repositories).
BOARD_GAINS = (
    (0.638, 0.813, 0.790, 0.974, 0.770, 0.800, 0.614, 1.0),
    (0.861, 0.993, 0.877, 0.844, 0.926, 1.0, 0.868, 0.939),
)
#: Phase difference that goes with each decibel of gain difference between I and Q.
IQ_DEG_PER_DB = 6.0
#: Range bins that spurs may fall on, and how many there are.
SPUR_BINS, SPURS = (30, 300), 2
#: A fault counts as flagged where at least this share of scans says something that unfaulted scans do not.
FLAGGED_SHARE = 0.5


class Hardware:
    """A radar as it really is; the faults of one case are done to it."""

    def __init__(self, scene: Scene, seed: int, fault: str) -> None:
        self.scene, self.seed = scene, seed
        self.setup: RadarSetup = scene.setup
        self.front_end = FrontEnd()
        self.effects = "basic"
        #: What becomes of each beam on its way to the chain; None: it never comes.
        self.spoil: Callable[[RadarBeam], RadarBeam | None] = lambda beam: beam
        self.rng = np.random.default_rng([seed, zlib.crc32(scene.name.encode()), zlib.crc32(fault.encode())])

    def weigh(self, columns: np.ndarray) -> None:
        """Multiply the weights of the columns, [columns] or [beams, columns]."""
        weights = (setup_weights(self.setup) * columns).astype(np.complex64)
        self.setup = msgspec.structs.replace(self.setup, steering_weights=weights)

    def with_effect(self, name: str, front_end: FrontEnd) -> None:
        """Give the receiver a fault and simulate it beside the basic effects."""
        self.front_end, self.effects = front_end, ",".join(sorted({*BASIC_USED, "adc", name}))

    def player(self, chirps_per_beam: int | None = None) -> ScenePlayer:
        """The scene as this hardware measures it."""
        radar = msgspec.structs.replace(self.scene.radar, front_end=self.front_end)
        scene = msgspec.structs.replace(self.scene, radar=radar)
        return ScenePlayer(scene, self.seed, self.setup, effects=self.effects, chirps_per_beam=chirps_per_beam)


def lost_beams(radar: Hardware, count: float) -> None:
    """Beams that never come."""
    lost = set(radar.rng.permutation(len(radar.setup.beams))[: int(count)].tolist())
    radar.spoil = lambda beam: None if beam.beam_index in lost else beam


def mute_beams(radar: Hardware, count: float) -> None:
    """Beams that come but hold noise alone: the array did not radiate."""
    beams = len(radar.setup.beams)
    radiates = np.ones((beams, 1))
    radiates[radar.rng.permutation(beams)[: int(count)]] = 0.0
    radar.weigh(radiates)


def gain_errors(radar: Hardware, spread: float) -> None:
    """Gains of the columns drawn between 1 - spread and 1."""
    radar.weigh(1.0 - spread * radar.rng.random(radar.setup.array.columns))


def measured_gains(radar: Hardware, board: float) -> None:
    """Gains as measured on a board, 1 or 2."""
    radar.weigh(np.array(BOARD_GAINS[int(board) - 1]))


def phase_errors(radar: Hardware, rms_deg: float) -> None:
    """Phases of the columns off by a normal draw."""
    radar.weigh(np.exp(1j * np.radians(rms_deg) * radar.rng.standard_normal(radar.setup.array.columns)))


def phase_bits(radar: Hardware, bits: float) -> None:
    """The array rounds its phases to other steps than its set-up says."""
    array = msgspec.structs.replace(radar.setup.array, phase_bits=int(bits))
    radar.setup = msgspec.structs.replace(radar.setup, array=array)


def iq_imbalance(radar: Hardware, gain_db: float) -> None:
    """Gain and phase difference of the receiver's two branches."""
    radar.with_effect("iq_imbalance", FrontEnd(iq_gain_db=gain_db, iq_phase_deg=IQ_DEG_PER_DB * gain_db))


def spurs(radar: Hardware, level_db: float) -> None:
    """Free-running tones on range bins, where the mean over chirps keeps all of them; level over a beam's noise."""
    params = radar.setup.radar
    bin_noise_mw = params.noise_power_mw * window_noise_gain("hann") / params.samples_per_chirp / params.chirps_per_beam
    power_dbm = db_from_ratio(bin_noise_mw) + level_db
    bins = radar.rng.integers(*SPUR_BINS, SPURS)
    tones = tuple(Spur(frequency_hz=float(one / params.chirp_period_s), power_dbm=power_dbm) for one in bins)
    radar.with_effect("spurs", FrontEnd(spurs=tones))


def clipping(radar: Hardware, percent: float) -> None:
    """Full scale lowered until this share of the samples clips."""
    short = radar.player(chirps_per_beam=1)
    codes = np.stack([short.beam(0, index).samples for index in range(len(short.setup.beams))])
    peak = float(np.quantile(np.abs(codes.astype(np.float64)).max(axis=-1), 1.0 - percent / 100.0))
    full_scale_dbm = radar.setup.full_scale_dbm + db_from_ratio((peak / FULL_SCALE_CODE) ** 2)
    radar.setup = msgspec.structs.replace(radar.setup, full_scale_dbm=full_scale_dbm)


def missing_chirps(radar: Hardware, percent: float) -> None:
    """Chirps of every beam lost on the link, zeros in their place."""
    chirps = radar.setup.radar.chirps_per_beam
    lost = np.stack([radar.rng.permutation(chirps) for _ in range(len(radar.setup.beams))])
    lost = lost[:, : round(percent / 100.0 * chirps)]

    def spoil(beam: RadarBeam) -> RadarBeam:
        samples = beam.samples.copy()
        samples[lost[beam.beam_index]] = 0
        return msgspec.structs.replace(beam, samples=samples)

    radar.spoil = spoil


def burst(radar: Hardware, level_db: float) -> None:
    """A foreign transmitter, white over the band, through one beam; level over the receiver's own noise."""
    hit = int(radar.rng.integers(len(radar.setup.beams)))
    rms = float(np.sqrt(0.5 * radar.setup.radar.noise_power_mw / radar.setup.milliwatt_per_code_squared))
    rms *= np.sqrt(ratio_from_db(level_db))
    rng = np.random.default_rng(radar.rng.integers(2**32))

    def spoil(beam: RadarBeam) -> RadarBeam:
        if beam.beam_index != hit:
            return beam
        codes = beam.samples + rms * rng.standard_normal(beam.samples.shape, np.float32)
        return msgspec.structs.replace(beam, samples=np.clip(np.rint(codes), -32768, 32767).astype(np.int16))

    radar.spoil = spoil


class Fault(msgspec.Struct, frozen=True):
    """One fault, its title and unit, severities from mild to severe, and what it does to a radar."""

    title: str
    unit: str
    severities: tuple[float, ...]
    inject: Callable[[Hardware, float], None]


def _nothing(radar: Hardware, severity: float) -> None:
    pass


FAULTS: dict[str, Fault] = {
    "none": Fault("no fault", "", (0,), _nothing),
    "lost_beams": Fault("beams that never come", "of 25", (1, 2, 4, 6, 8, 10, 12), lost_beams),
    "mute_beams": Fault("beams of noise alone", "of 25", (1, 2, 4, 6, 8, 10, 12), mute_beams),
    "gain_errors": Fault("gains of the columns", "spread", (0.1, 0.2, 0.4, 0.6, 0.8, 1.0), gain_errors),
    "measured_gains": Fault("gains of real boards", "board", (2, 1), measured_gains),
    "phase_errors": Fault("phases of the columns", "deg rms", (5, 10, 15, 20, 30, 45, 60), phase_errors),
    "phase_bits": Fault("phase steps (stated: 6)", "bits", (8, 7, 5, 4, 3, 2), phase_bits),
    "iq_imbalance": Fault("I/Q imbalance (6 deg per dB)", "dB", (0.5, 1, 2, 4, 6), iq_imbalance),
    "spurs": Fault("two spurs", "dB over noise", (10, 20, 30, 40, 50, 60, 70), spurs),
    "clipping": Fault("clipped samples", "%", (0.01, 0.1, 1, 3, 10, 30), clipping),
    "missing_chirps": Fault("chirps lost in every beam", "%", (2, 10, 25, 50, 75, 90, 97), missing_chirps),
    "burst": Fault("burst of noise in one beam", "dB over noise", (0, 10, 20, 30, 40, 50), burst),
}


class Case(msgspec.Struct, kw_only=True):
    """What came of one fault at one severity in one scene with one seed."""

    fault: str
    severity: float
    scene: str
    seed: int
    asked: int = 0
    #: Face and centre errors (`models.scores.object_error`) of the found.
    errors_m: list[float] = []
    centre_errors_m: list[float] = []
    missed: int = 0
    ghosts: int = 0
    points: list[int] = []
    flags: list[str] = []


@lru_cache
def _detector(radar_height_m: float) -> NetworkDetector:
    """The network for the radar as stated, which is the same in all scenes but for its height."""
    return NetworkDetector(RadarSetup(radar_height_m=radar_height_m))


def view_of(radar: Hardware) -> tuple[BevFrame, SceneTruth]:
    """One scan through a chain that holds the radar for what its set-up says."""
    player, stated = radar.player(), radar.scene.setup
    chain = Chain(FormingStage(), DetectionStage(lambda setup: _detector(setup.radar_height_m)), ViewStage())
    chain.set_up(stated)
    count = len(stated.beams)
    # the next scan's first beam closes a scan that lacks its last one
    beams = [player.beam(0, index) for index in range(count)] + [player.beam(1, 0)]
    for beam in beams:
        came = radar.spoil(beam) if beam.scan_id == 0 else beam
        for view in [] if came is None else chain.add(came):
            return view.frame, player.truth(0)
    raise ValueError(f"{radar.scene.name}: no beam of the scan came")


def run(fault: str, severity: float, scene: Path, seed: int) -> Case:
    """One case from scene to counts."""
    radar = Hardware(load_scene(scene), seed, fault)
    FAULTS[fault].inject(radar, severity)
    frame, truth = view_of(radar)
    match = match_objects(frame.objects, truth)
    found_m = np.array([(point.x_m, point.y_m) for point in frame.points]).reshape(-1, 2)
    points = recovered_counts(found_m, truth.hidden_points_m[:, :2].astype(np.float64))
    return Case(
        fault=fault,
        severity=severity,
        scene=scene.stem,
        seed=seed,
        asked=len(match.matched) + len(match.missed_truths),
        errors_m=[error_m for _, _, error_m in match.matched],
        centre_errors_m=list(match.centre_m),
        missed=len(match.missed_truths),
        ghosts=len(match.unmatched_objects),
        points=[points.true_positives, points.false_positives, points.false_negatives],
        flags=list(frame.flags),
    )


class Row(msgspec.Struct, kw_only=True):
    """One fault at one severity over scenes and seeds."""

    fault: str
    severity: float
    scans: int
    asked: int
    found: int
    missed: int
    ghosts: int
    #: Face error, and centre error.
    error_mean_m: float | None
    error_p90_m: float | None
    centre_error_mean_m: float | None
    centre_error_p90_m: float | None
    points_f1: float
    #: Share of scans that say something unfaulted scans do not, and the share that raises each flag.
    flagged: float
    flags: dict[str, float]
    #: Scans that miss or make up an object and raise no flag.
    silent: int

    @property
    def found_share(self) -> float:
        return self.found / self.asked if self.asked else 1.0


def summarise(cases: Sequence[Case]) -> Row:
    """All cases of one fault at one severity."""
    errors_m = [error_m for case in cases for error_m in case.errors_m]
    centre_m = [error_m for case in cases for error_m in case.centre_errors_m]
    counts = sum((Counts(*case.points) for case in cases), Counts())
    raised = Counter(flag for case in cases for flag in case.flags)
    return Row(
        fault=cases[0].fault,
        severity=cases[0].severity,
        scans=len(cases),
        asked=sum(case.asked for case in cases),
        found=len(errors_m),
        missed=sum(case.missed for case in cases),
        ghosts=sum(case.ghosts for case in cases),
        error_mean_m=float(np.mean(errors_m)) if errors_m else None,
        error_p90_m=float(np.quantile(errors_m, 0.9)) if errors_m else None,
        centre_error_mean_m=float(np.mean(centre_m)) if centre_m else None,
        centre_error_p90_m=float(np.quantile(centre_m, 0.9)) if centre_m else None,
        points_f1=counts.f1,
        flagged=sum(bool(case.flags) for case in cases) / len(cases),
        flags={flag: count / len(cases) for flag, count in sorted(raised.items())},
        silent=sum(not case.flags and case.missed + case.ghosts > 0 for case in cases),
    )


def _file(work: Path, fault: str, severity: float, scene: Path, seed: int) -> Path:
    return work / f"{fault}_{severity:g}_{scene.stem}_{seed}.json"


def measure(wanted: list[tuple[str, float, Path, int]], work: Path) -> list[Case]:
    """All cases asked for, from their files where they are there."""
    work.mkdir(parents=True, exist_ok=True)
    cases = []
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("severity", total=len(wanted))
        for fault, severity, scene, seed in wanted:
            file = _file(work, fault, severity, scene, seed)
            progress.update(task, description=f"{fault} {severity:g} {scene.stem}")
            if file.is_file():
                case = msgspec.json.decode(file.read_bytes(), type=Case)
            else:
                case = run(fault, severity, scene, seed)
                part = file.with_suffix(".part")
                part.write_bytes(msgspec.json.encode(case))
                part.replace(file)
            cases.append(case)
            progress.advance(task)
    return cases


def rows_of(cases: Sequence[Case]) -> list[Row]:
    """One row a fault and severity, in the order of `FAULTS`."""
    rows = []
    for name, fault in FAULTS.items():
        for severity in fault.severities:
            mine = [case for case in cases if (case.fault, case.severity) == (name, severity)]
            rows += [summarise(mine)] if mine else []
    return rows


def table(rows: Sequence[Row]) -> str:
    """Markdown table of all rows."""
    lines = [
        "| fault | severity | found / asked | made up | face error mean, p90 [m] | centre error mean, p90 [m] "
        "| points F1 | flagged | flags | silent |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        fault = FAULTS[row.fault]
        errors = "-" if row.error_mean_m is None else f"{row.error_mean_m:.2f}, {row.error_p90_m:.2f}"
        centres = "-" if row.error_mean_m is None else f"{row.centre_error_mean_m:.2f}, {row.centre_error_p90_m:.2f}"
        flags = ", ".join(f"{flag} {share:.0%}" for flag, share in row.flags.items())
        lines.append(
            f"| {fault.title} | {row.severity:g} {fault.unit} | {row.found} / {row.asked} | {row.ghosts} | {errors} "
            f"| {centres} | {row.points_f1:.2f} | {row.flagged:.0%} | {flags or '-'} | {row.silent} |"
        )
    return "\n".join(lines) + "\n"


#: Colours told apart by everyone (Okabe and Ito).
_BLUE, _RED, _GREEN, _SHADE = "#0072B2", "#D55E00", "#009E73", "#F0E442"
#: Drawn as points of another fault, at the spread that the board's gains have.
_BOARDS = "measured_gains"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Small multiples: one pair of panels a fault, found share over face error, flagged severities shaded."""
    of_fault = {name: [row for row in rows if row.fault == name] for name in FAULTS}
    names = [name for name, mine in of_fault.items() if mine and name not in ("none", _BOARDS)]
    across = min(3, len(names))
    down = -(-len(names) // across)
    figure = new_figure(max(3.3 * across, 7.0), 3.5 * down + 1.0)
    blocks = figure.subfigures(down, across, squeeze=False)
    for name, block in zip(names, blocks.ravel(), strict=False):
        shares, errors = block.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        _draw_fault(shares, errors, FAULTS[name], of_fault["none"] + of_fault[name])
        shares.set_ylim(-0.05, 1.1 * max(1.0, *(row.ghosts / row.scans for row in rows)))
        if name == "gain_errors":
            _draw_boards(shares, errors, of_fault[_BOARDS])
    scans = min(row.scans for row in rows)
    title = f"Hidden vehicles in six scenes under hardware faults that the chain does not know, {scans} scans a point"
    legend_of_figure(figure, handles_of(*figure.axes), columns=3, loc="outside upper center", title=title)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(figure, path)


def _draw_fault(shares: Any, errors: Any, fault: Fault, rows: Sequence[Row]) -> None:
    """One fault: severities at equal steps, the unfaulted radar first."""
    at = np.arange(len(rows))
    shares.plot(at, [row.found_share for row in rows], "o-", color=_BLUE, ms=4, label="share of hidden vehicles found")
    shares.plot(at, [row.ghosts / row.scans for row in rows], "s--", color=_RED, ms=4, label="made up, per scan")
    nan = float("nan")
    means = [nan if row.error_mean_m is None else row.error_mean_m for row in rows]
    tails = [nan if row.error_p90_m is None else row.error_p90_m for row in rows]
    centres = [nan if row.centre_error_mean_m is None else row.centre_error_mean_m for row in rows]
    errors.plot(at, means, "o-", color=_GREEN, ms=4, label="face error, mean")
    errors.plot(at, tails, "^:", color=_GREEN, ms=4, mfc="white", label="its 90th percentile")
    errors.plot(at, centres, "d--", color="0.3", ms=4, label="centre error, mean")
    # the mildest severity that most scans flag: rows grow
    flagged = next((row for row in rows if row.flagged >= FLAGGED_SHARE), None)
    harmless = all(row.missed + row.ghosts == 0 for row in rows)
    said = "not flagged, nothing missed or made up" if harmless else "not flagged"
    if flagged is not None:
        first = next(index for index, row in enumerate(rows) if row is flagged)
        for axis in (shares, errors):
            label = "flagged in half of the scans or more" if axis is errors else None
            axis.axvspan(first - 0.5, len(rows) - 0.5, color=_SHADE, alpha=0.35, lw=0, label=label)
        # a flag of its own says more than the general one
        telling = max(flagged.flags, key=lambda flag: (flagged.flags[flag], flag != "missing_beams"))
        said = f"flagged from {flagged.severity:g}: {telling.replace('_', ' ')}"
    shares.set_title(f"{fault.title}\n{said}", fontsize=9)
    shares.set(ylabel="share", yticks=(0, 0.5, 1, 1.5), xlim=(-0.5, len(rows) - 0.5))
    errors.set(ylim=(0, 2.5), yticks=(0, 1, 2), ylabel="error [m]", xticks=at)
    errors.set_xticklabels(["none", *(f"{row.severity:g}" for row in rows[1:])], fontsize=8)
    errors.set_xlabel(fault.unit, fontsize=9)
    for axis in (shares, errors):
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)


def _draw_boards(shares: Any, errors: Any, rows: Sequence[Row]) -> None:
    """Measured boards as stars among drawn gains."""
    for row in rows:
        spread = 1.0 - min(BOARD_GAINS[int(row.severity) - 1])
        at = np.interp(spread, (0.0, *FAULTS["gain_errors"].severities), np.arange(7))
        shares.plot(at, row.found_share, "*", color="black", ms=9)
        errors.plot(at, row.error_mean_m, "*", color="black", ms=9)
        errors.annotate(f"board {row.severity:g}", (at, row.error_mean_m), (0, -12), textcoords="offset points",
                        ha="center", fontsize=8)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faults", nargs="*", choices=list(FAULTS), default=list(FAULTS))
    names = [scene.stem for scene in SCENES]
    parser.add_argument("--scenes", nargs="*", choices=names, default=names)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--work", type=Path, default=Path("runs/severity"))
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--table", type=Path)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    wanted = [
        (fault, severity, scene, seed)
        for seed in range(arguments.seed, arguments.seed + arguments.seeds)
        for fault in arguments.faults
        for severity in FAULTS[fault].severities
        for scene in SCENES
        if scene.stem in arguments.scenes
    ]
    rows = rows_of(measure(wanted, arguments.work))
    if arguments.figure is not None:
        draw(rows, arguments.figure)
    if arguments.table is not None:
        arguments.table.write_text(table(rows), encoding="utf-8")
    if arguments.json:
        machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.platform()}"
        print(json.dumps({"machine": machine, "seeds": arguments.seeds, "rows": msgspec.to_builtins(rows)}))
    else:
        print(table(rows), end="")


if __name__ == "__main__":
    main()
