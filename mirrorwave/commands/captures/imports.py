"""`mirrorwave import`: captures and logs of others as data sets and recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mirrorwave.commands.captures.can import DBC, MAPPING, Channel, Dbc, Mapping
from mirrorwave.commands.verbs import loaded
from mirrorwave.console import (
    AsJson,
    ExitCode,
    print_json,
    print_line,
    print_result,
    print_table,
    progress_bar,
    require_new_file,
)
from msgs.values.wording import counted

app = typer.Typer(no_args_is_help=True, help="Bring captures and logs of others in.")
app.command()(loaded("contrib.imports.verb:sensors"))


@app.callback()
def _group() -> None:
    """Bring captures and logs of others in."""


@app.command()
def xradarnlos(
    folder: Annotated[Path, typer.Argument(metavar="SOURCE", help="Folder in the published layout.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Data set to write; must be empty or new.")],
    kind: Annotated[
        Literal["sim", "real"], typer.Option(help="Simulated maps (.npy, .npz) or captures (Welch spectra).")
    ] = "sim",
    skip_broken: Annotated[bool, typer.Option(help="Count captures that cannot be read; exit code 3.")] = False,
    as_json: AsJson = False,
) -> int:
    """The published simulated maps or real captures as a data set of maps, for `train` and `eval`."""
    from lab.training.data.xradarnlos import import_folder

    if not folder.is_dir():
        raise NotADirectoryError(20, "must be a folder", str(folder))
    with progress_bar("captures") as progress:
        summary = import_folder(folder, out, kind, skip_broken, progress.update)
    for reason in summary.broken:
        typer.echo(f"mirrorwave: left out: {reason}", err=True)
    line = (
        f"{out}: {counted(summary.frames, 'frame')}, {summary.los_points} LOS and "
        f"{counted(summary.mirrored_points, 'mirrored point')}, "
        f"{counted(summary.negative_cells, 'cell')} below zero, {counted(len(summary.broken), 'capture')} left out"
    )
    print_result(as_json, {"folder": str(out), "kind": kind, **vars(summary)}, line)
    return ExitCode.DONE_WITH_LOSS if summary.broken else ExitCode.DONE


@app.command()
def dca1000(
    capture: Annotated[
        list[Path],
        typer.Argument(metavar="SOURCE", help="Raw samples as the DCA1000 stored them, in one file or several."),
    ],
    config: Annotated[
        Path, typer.Option(metavar="FILE", help="Chirps: a TI .cfg or .json, or a .lua of mmWave Studio.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for maps, picture and summary; empty or new.")],
    device: Annotated[
        Literal["xwr14xx", "xwr16xx", "xwr18xx", "awr2944", "awrl6844", "awr2243_cascade"] | None,
        typer.Option(help='Device, where FILE does not name it ("% Platform:").'),
    ] = None,
    remove_static: Annotated[bool, typer.Option(help="Take off what stands still.")] = False,
    mirrored: Annotated[bool, typer.Option(help="Receivers run to the right as the radar looks.")] = False,
    min_range_m: Annotated[float, typer.Option(metavar="M", help="List no return nearer than this.")] = 0.0,
    recording: Annotated[
        Path | None, typer.Option(metavar="REC.mcap", help="New recording of beams, to process or replay.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Raw frames of a TI board as range-azimuth maps, with a picture and the strongest returns."""
    from contrib.boards.config_file import read_config
    from contrib.boards.dca1000_capture import frames_of
    from contrib.boards.import_dca1000 import (
        ImportParams,
        capture_bytes,
        capture_files,
        import_capture,
        write_recording,
    )

    params = ImportParams(remove_static=remove_static, mirrored=mirrored, min_range_m=min_range_m)
    chirps = read_config(config, device)
    files = capture_files(capture, chirps)
    for file in files[len(capture) :]:
        typer.echo(f"mirrorwave: {capture[0]}: goes on in {file}", err=True)
    layout = frames_of(capture_bytes(files, chirps), chirps, str(capture[0]))
    if recording is not None:
        require_new_file(recording)
        with progress_bar("scans", layout.whole) as advance:
            write_recording(files, config, chirps, recording, params, layout, advance)
    with progress_bar("frames", layout.whole) as advance:
        summary = import_capture(files, config, chirps, out, params, layout, advance)
    if layout.loss:
        typer.echo(f"mirrorwave: {capture[0]}: {layout.loss}", err=True)
    if as_json:
        print_json({"folder": str(out), **summary})
    else:
        names = ("range_m", "azimuth_deg", "closing_speed_mps", "snr_db")
        print_table(
            ("frame", *names),
            [
                [each["frame"], *(echo[name] for name in names)]
                for each in summary["per_frame"]
                for echo in each["returns"]
            ],
        )
        print_line(f"{out}: {counted(layout.whole, 'map')}, ra_map.png and summary.json")
    return ExitCode.DONE_WITH_LOSS if layout.loss else ExitCode.DONE


@app.command()
def board(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Folder of an Infineon BGT60TR13C, or .dat of an Ancortek kit.")
    ],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="New recording of set-up and beams.")],
    as_json: AsJson = False,
) -> int:
    """Raw samples of an Infineon or Ancortek board as a recording; exit code 3 if some are left out."""
    from contrib.imports.board_recordings import import_board

    require_new_file(out)
    counts = import_board(source, out, progress_bar)
    typer.echo(f"mirrorwave: {source}: assumed: {counts['assumed']}", err=True)
    if counts["loss"]:
        typer.echo(f"mirrorwave: {source}: {counts['loss']}", err=True)
    line = f"{out}: {counted(counts['beams'], 'beam')} of {counted(counts['scans'], 'scan')}"
    print_result(as_json, {"recording": str(out), **counts}, line)
    return ExitCode.DONE_WITH_LOSS if counts["loss"] else ExitCode.DONE


@app.command()
def can(
    log: Annotated[Path, typer.Argument(metavar="SOURCE", help="candump (.log), ASC, BLF, CSV or TRC, also gzipped.")],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="New recording of vehicle/state.")],
    dbc: Dbc = DBC,
    mapping: Mapping = MAPPING,
    channel: Channel = None,
    start_ns: Annotated[
        int | None, typer.Option("--start-ns", metavar="N", help="Stamp of the first frame, to fit another recording.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """A CAN log as a recording of the vehicle's state; exit code 3 if the log breaks off."""
    from mirrorwave.convert.logs import CanSource, import_can
    from msgs.files.shipped import shipped_path

    require_new_file(out)
    source = CanSource(
        log=log, dbc=shipped_path(dbc), mapping=shipped_path(mapping), channel=channel, start_ns=start_ns
    )
    with progress_bar(f"reading {log.name}"):
        counts = import_can(source, out)
    if counts["loss"]:
        typer.echo(f"mirrorwave: the log breaks off: {counts['loss']}", err=True)
    if as_json:
        print_json({"recording": str(out), **counts})
    else:
        verdicts = ", ".join(f"{count} {verdict}" for verdict, count in counts["frames_by_verdict"].items())
        print_line(f"{out}: {counted(counts['states'], 'state')}, {counts['valid_states']} valid")
        print_line(f"{counted(counts['frames'], 'frame')}: {verdicts}")
    return ExitCode.DONE_WITH_LOSS if counts["loss"] else ExitCode.DONE


@app.command()
def detections(
    source: Annotated[
        Path,
        typer.Argument(metavar="SOURCE", help="Table, ROS bag, or file or folder of a data set (see the guide)."),
    ],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="New recording of radar/detections.")],
    mapping: Annotated[
        Path | None, typer.Option("--mapping", help="From columns or fields to detections, YAML; bags have a default.")
    ] = None,
    topic: Annotated[
        str | None, typer.Option("--topic", help="Topic of a bag or sensor of a drive, where it has several.")
    ] = None,
    as_json: AsJson = False,
) -> int:
    """Detections of a radar that gives no beats; exit code 3 if any are left out."""
    from contrib.imports.detections import import_detections

    require_new_file(out)
    counts = import_detections(source, out, mapping, topic, progress_bar)
    for reason, count in counts["left_out"].items():
        typer.echo(f"mirrorwave: {source}: left out: {count}: {reason}", err=True)
    if counts["loss"]:
        typer.echo(f"mirrorwave: {counts['loss']}", err=True)
    line = f"{out}: {counted(counts['detections'], 'detection')} in {counted(counts['scans'], 'scan')}"
    print_result(as_json, {"recording": str(out), **counts}, line)
    return ExitCode.DONE_WITH_LOSS if counts["left_out"] or counts["loss"] else ExitCode.DONE


@app.command()
def sigmf(
    capture: Annotated[Path, typer.Argument(metavar="SOURCE", help="Capture: its .sigmf-meta, .sigmf-data or stem.")],
    out: Annotated[Path, typer.Option(metavar="REC.mcap", help="New recording of set-up and raw beams.")],
    as_json: AsJson = False,
) -> int:
    """A SigMF capture as a recording; one that does not fit is refused, naming the field."""
    from mirrorwave.convert.logs import import_sigmf
    from msgs.recording.sigmf import SigmfCapture

    require_new_file(out)
    with progress_bar("beams", len(SigmfCapture.open(capture, verify=False))) as advance:
        counts = import_sigmf(capture, out, advance)
    line = f"{out}: {counted(counts['beams'], 'beam')}, {counted(counts['truth'], 'truth')}"
    print_result(as_json, {"recording": str(out), **counts}, line)
    return ExitCode.DONE


@app.command()
def transients(
    capture: Annotated[Path, typer.Argument(metavar="SOURCE", help="Photon counts of a confocal scan of a wall.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for picture, arrays and summary; empty or new.")],
    min_range_m: Annotated[
        float, typer.Option(metavar="M", help="Light from nearer than this to the wall is the wall's own.")
    ] = 0.36,
    bin_ps: Annotated[float, typer.Option(metavar="PS", help="Width of a time bin, which the file does not name.")] = (
        4.0
    ),
    falloff: Annotated[
        Literal["retroreflective", "matt"],
        typer.Option(help="Loss over distance of a hidden surface: r^-2 of retroreflectors, r^-4 of matt ones."),
    ] = "retroreflective",
    as_json: AsJson = False,
) -> int:
    """Real photons of a hidden object as its shape, by the light-cone transform."""
    from lab.transients.import_transients import import_transients

    with progress_bar(f"reading {capture.name}"):
        summary = import_transients(capture, out, 1e-12 * bin_ps, min_range_m, falloff)
    line = (
        f"{out}: hidden surface {summary['distance_m']:.3f} m from the wall, tilted by {summary['tilt_deg']:.1f} "
        f"deg; {summary['hidden_photons']} of {summary['photons']} photons; hidden.png, hidden.npz, summary.json"
    )
    print_result(as_json, {"folder": str(out), **summary}, line)
    return ExitCode.DONE
