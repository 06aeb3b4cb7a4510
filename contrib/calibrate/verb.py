"""`mirrorwave calibrate`: what a recording says of the radar, its mounting and its clock, in files the graph reads."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mirrorwave.console import (
    AsJson,
    ExitCode,
    print_json,
    print_line,
    print_table,
    progress_bar,
    require_new_file,
    require_picture,
)
from msgs.values.wording import counted

if TYPE_CHECKING:
    from contrib.calibrate.drive import Solved
    from contrib.calibrate.mounting import Mounting

app = typer.Typer(
    no_args_is_help=True, help="Background and noise of the radar; its pose on the vehicle; its clock against CAN."
)

CaptureFile = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="SigMF capture or MCAP recording with raw beams.")
]
DriveFile = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="MCAP recording of a drive: vehicle/state, raw beams or peaks.")
]
Out = Annotated[Path, typer.Option(metavar="FILE", help="Result; must not exist.")]
Plot = Annotated[Path | None, typer.Option("--plot", metavar="PNG", help="Picture of the result.")]
#: Scans that are read at most; a noise floor needs fewer.
SCANS, NOISE_SCANS = 100, 20
Pose = Annotated[
    tuple[float, float, float] | None,
    typer.Option(metavar="X_M Y_M YAW_DEG", help="Pose of the radar on the vehicle as far as it is known."),
]


@app.command()
def background(capture: CaptureFile, out: Out, plot: Plot = None, as_json: AsJson = False) -> None:
    """Open-field background of every beam, for `ra_former.background`."""
    from contrib.calibrate.capture import Capture
    from contrib.calibrate.radar_alone import draw_background, measure_background, save_background

    _require_suffix(out, ".npy")
    _require_new(out, plot)
    source = Capture(capture)
    with progress_bar("scans", min(SCANS, source.scan_count())) as advance:
        values, quality = measure_background(source, SCANS, advance)
    save_background(values, out)
    if plot is not None:
        draw_background(values, source, plot)
    if as_json:
        print_json({"out": str(out), "quality": quality, "loss": source.loss})
    else:
        print_line(
            f"static: {quality.leakage_dbm:.1f} dBm at {quality.leakage_range_m:.2f} m, {quality.removed_db:.1f} dB of "
            f"it removed from scans it was not made of (down to {quality.left_dbm:.1f} dBm, their noise)"
        )
        print_line(
            f"noise: {quality.scan_noise_dbm:.1f} dBm per bin of a scan's beam, {quality.noise_dbm:.1f} dBm after "
            f"{counted(quality.scans, 'scan')} (10 log N: {quality.expected_noise_dbm:.1f} dBm)"
        )
        print_line(f"left out as moving: {100.0 * quality.outlier_share:.3f} % of cells")
        print_line(f"wrote {out}; use it with -p ra_former.background={out}")
    _end(source.loss, as_json)


@app.command()
def noise(
    capture: CaptureFile,
    out: Out,
    scene: Annotated[
        Path | None, typer.Option(metavar="SCENE", help="Write this scene with the receiver, not the receiver alone.")
    ] = None,
    leakage_to_m: Annotated[
        float | None, typer.Option(help="Measure the leakage: the strongest return up to this range.")
    ] = None,
    image_about_khz: Annotated[
        float | None,
        typer.Option(help="Measure the imbalance of I and Q: where the receiver mirrors (0; beats shifted by -f: -f)."),
    ] = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Noise, 1/f corner, spurs, leakage, I/Q imbalance of the receiver, for the simulator; sidebands are told."""
    from contrib.calibrate.capture import Capture
    from contrib.calibrate.front_end_faults import FaultParams
    from contrib.calibrate.radar_alone import draw_noise, floor_lines, measure_noise, receiver_text
    from msgs.files.whole_files import write_whole

    _require_new(out, plot)
    image_about_hz = None if image_about_khz is None else 1e3 * image_about_khz
    faults = FaultParams(leakage_to_m=leakage_to_m, image_about_hz=image_about_hz)
    source = Capture(capture)
    with progress_bar("scans", min(NOISE_SCANS, source.scan_count())) as advance:
        floor = measure_noise(source, NOISE_SCANS, faults, advance)
    write_whole(out, receiver_text(floor, scene).encode())
    if plot is not None:
        draw_noise(floor, plot)
    if as_json:
        print_json({"out": str(out), "floor": floor, "loss": source.loss})
    else:
        bands = [band for band in floor.bands if band.range_m >= 0.01][::3]
        print_table(
            ("range_m", "measured_dbm", "model_dbm"),
            [(band.range_m, f"{band.measured_dbm:.2f}", f"{band.modelled_dbm:.2f}") for band in bands],
        )
        for line in floor_lines(floor, faults):
            print_line(line)
        print_line(f"wrote {out}")
    _end(source.loss, as_json)


@app.command()
def array(
    capture: CaptureFile,
    out: Out,
    range_m: Annotated[
        tuple[float, float], typer.Option(metavar="LOW_M HIGH_M", help="Where the reflector is the strongest return.")
    ],
    azimuth_deg: Annotated[float, typer.Option(help="Azimuth of the reflector, left positive.")] = 0.0,
    as_json: AsJson = False,
) -> None:
    """Gain and phase of each element of a Phaser board, from a reflector heard element by element."""
    from contrib.calibrate.array import element_rows, measure_array, write_calibration
    from contrib.calibrate.capture import Capture

    _require_new(out, None)
    source = Capture(capture)
    with progress_bar("scans", min(SCANS, source.scan_count())) as advance:
        calibration, responses = measure_array(source, range_m, azimuth_deg, SCANS, advance)
    write_calibration(out, calibration, responses)
    if as_json:
        print_json({"out": str(out), "calibration": calibration, "range_m": responses.range_m, "loss": source.loss})
    else:
        print_table(("element", "gain", "phase_deg", "snr_db", "spread_deg"), element_rows(calibration, responses))
        print_line(f"reflector: {responses.range_m:.2f} m; channels {calibration.channel_gains_db} dB")
        print_line(f"wrote {out}; use it with -p radar_driver.cn0566.calibration={out}")
    _end(source.loss, as_json)


@app.command()
def extrinsic(
    recording: DriveFile,
    out: Out,
    prior: Pose = None,
    clock_offset_s: Annotated[
        float | None, typer.Option(help="Clock offset, where it is known; else found as well.")
    ] = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Pose of the radar on the vehicle, from straight walls seen while driving."""
    from contrib.calibrate.drive import DriveParams
    from contrib.calibrate.mounting_file import write_params

    _require_new(out, plot)
    params = DriveParams(prior=_pose(prior), clock_offset_s=clock_offset_s)
    solved = _solved(recording, params, plot, "Walls in the odometry frame")
    mounting = solved.mounting
    if not mounting.yaw_rad.observed:
        raise ValueError(
            f"{recording}: this drive does not tell the radar's yaw (standard deviation "
            f"{math.degrees(mounting.yaw_rad.std):.2f} deg): see more walls for longer"
        )
    pose = mounting.vehicle_from_radar
    params_file = {"ra_former": {"vehicle_from_radar": {"x_m": pose.x_m, "y_m": pose.y_m, "yaw_rad": pose.yaw_rad}}}
    write_params(out, params_file, mounting)
    _say_mounting(mounting, out, solved.loss, as_json)


@app.command()
def clock(
    recording: DriveFile,
    out: Out,
    pose: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X_M Y_M YAW_DEG", help="Pose of the radar, where it is known; else found as well."),
    ] = None,
    plot: Plot = None,
    as_json: AsJson = False,
) -> None:
    """Offset of the radar's clock from that of vehicle/state, from a drive with changing speed or yaw rate."""
    from contrib.calibrate.drive import DriveParams
    from contrib.calibrate.mounting_file import write_params

    _require_new(out, plot)
    params = DriveParams(prior=_pose(pose), known_pose=pose is not None)
    solved = _solved(recording, params, plot, "Walls in the odometry frame")
    mounting = solved.mounting
    if not mounting.clock_offset_s.observed:
        raise ValueError(
            f"{recording}: this drive does not tell the clock's offset (standard deviation "
            f"{1e3 * mounting.clock_offset_s.std:.0f} ms): speed changed by {mounting.drive.speed_span_mps:.1f} m/s, "
            f"yaw rate by {mounting.drive.yaw_rate_span_dps:.1f} deg/s; drive with changing speed and yaw rate"
        )
    write_params(out, {"vehicle_can": {"clock_offset_s": mounting.clock_offset_s.value}}, mounting)
    _say_mounting(mounting, out, solved.loss, as_json)


def _solved(recording: Path, params: Any, plot: Path | None, title: str) -> Solved:
    """The mounting of a recording, and its picture."""
    from contrib.calibrate.capture import Capture
    from contrib.calibrate.drive import PASSES, draw_drive, solve_drive

    source = Capture(recording)
    with progress_bar("scans", PASSES * source.scan_count()) as advance:
        solved = solve_drive(recording, params, advance)
    if plot is not None:
        draw_drive(solved, list(source.messages(("vehicle/state",))), plot, title)
    return solved


def _pose(values: tuple[float, float, float] | None) -> Any:
    from msgs.values.frames import Pose2

    return Pose2() if values is None else Pose2(values[0], values[1], math.radians(values[2]))


def _say_mounting(mounting: Mounting, out: Path, loss: str | None, as_json: bool) -> None:
    from contrib.calibrate.mounting_file import mounting_lines

    if as_json:
        print_json({"out": str(out), "mounting": mounting, "loss": loss})
    else:
        print_table(
            ("wall", "sightings", "points", "rms_m"),
            [(index, wall.sightings, wall.points, wall.rms_m) for index, wall in enumerate(mounting.walls)],
        )
        print_line(
            f"drive: {mounting.drive.way_m:.1f} m, turned {mounting.drive.turned_deg:.0f} deg, "
            f"speed over {mounting.drive.speed_span_mps:.1f} m/s, "
            f"yaw rate over {mounting.drive.yaw_rate_span_dps:.1f} deg/s"
        )
        print_line(
            f"odometry: yaw rate bias {math.degrees(mounting.yaw_rate_bias_rps):.3f} deg/s, "
            f"speed times {mounting.speed_scale:.4f}"
        )
        print_line(f"rms off the walls: {mounting.rms_before_m:.3f} m as given, {mounting.rms_m:.3f} m as found")
        for line in mounting_lines(mounting):
            print_line(line)
        print_line(f"wrote {out}")
    _end(loss, as_json)


def _require_suffix(out: Path, suffix: str) -> None:
    if out.suffix != suffix:
        raise ValueError(f"{out}: the name must end in {suffix}")


def _require_new(out: Path, plot: Path | None) -> None:
    require_new_file(out)
    if plot is not None:
        require_picture(plot)
        require_new_file(plot)


def _end(loss: str | None, as_json: bool) -> None:
    """Exit code 3 where the recording lacks something."""
    if loss is None:
        return
    if not as_json:
        print_line(loss)
    raise typer.Exit(ExitCode.DONE_WITH_LOSS)
