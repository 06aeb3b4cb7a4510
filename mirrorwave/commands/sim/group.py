"""`mirrorwave sim`: captures and datasets from simulated scenes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mirrorwave.commands.sim.dataset import dataset, statistics
from mirrorwave.commands.sim.effects import Budget, Effects, For, SceneFile, effects, paths
from mirrorwave.commands.sim.map_import import app as import_app
from mirrorwave.commands.verbs import loaded
from mirrorwave.console import print_line, progress_bar, require_new_file
from msgs.values.wording import counted

if TYPE_CHECKING:
    from msgs.bus.interface import Outgoing
    from msgs.values.radar import RadarSetup

app = typer.Typer(no_args_is_help=True, help="Simulated scenes: raw captures, labelled datasets, materials, effects.")
#: Endings of what `sim run` writes; without one it is SigMF, two files of that name.
_CAPTURES = (".mcap", ".sigmf-meta", ".sigmf-data")
#: Verbs in order; those from beside the floors by name.
_VERBS = (
    *(effects, paths, "lab.commands.material:material"),
    *("lab.commands.fdtd:reflectance", dataset, statistics, "contrib.annotate.lidar_verb:lidar"),
)
for verb in _VERBS:
    app.command()(loaded(verb) if isinstance(verb, str) else verb)
app.add_typer(import_app, name="import")


@app.command()
def run(
    scene: SceneFile,
    out: Annotated[Path, typer.Option(help="Capture to write: NAME.mcap, or NAME.sigmf-meta for SigMF.")],
    scans: Annotated[int, typer.Option(min=1)] = 1,
    seed: int = 0,
    chirps_per_beam: Annotated[int | None, typer.Option(min=1, help="Fewer chirps, smaller files.")] = None,
    choice: Effects = "auto",
    budget_db: Budget = -20.0,
    purpose: For = "samples",
    walls: Annotated[
        Literal["none", "true", "noisy"],
        typer.Option(help="Record the scene's walls too, as a map knows them: exact, or with errors and gaps."),
    ] = "none",
) -> None:
    """Record what the radar or the LiDAR of a scene would measure, with the truth."""
    from msgs.files.whole_files import require_room
    from nodes import player
    from sim_player.player import ScenePlayer

    require_new_file(out)
    if walls != "none" and out.suffix != ".mcap":
        raise ValueError(f"--out {out}: SigMF has no place for --walls {walls}, they are recorded as NAME.mcap")
    if out.suffix not in ("", *_CAPTURES):
        raise ValueError(f"--out {out}: a capture's name must end in {' or '.join(_CAPTURES)}, got {out.suffix!r}")
    params = player.Params(
        scene=str(scene),
        seed=seed,
        scans=scans,
        chirps_per_beam=chirps_per_beam,
        effects=choice,
        budget_db=budget_db,
        purpose=purpose,
        walls=walls,
    )
    with progress_bar("tracing and planning"):
        source = player.scene_player(params)
    radars, total = dict[str, ScenePlayer](), 0
    if not player.is_lidar(source):
        radars = player.radars_of(source)
        total = sum(scans * len(radar.setup.beams) for radar in radars.values())
        total += scans * (len(source.setup.beams) + 1 + (walls != "none"))
    if not isinstance(source, ScenePlayer) and out.suffix != ".mcap":
        what = "several radars are" if radars else "a LiDAR is"
        raise ValueError(f"--out {out}: SigMF holds raw beams of one radar, {what} recorded as NAME.mcap")
    if radars:
        require_room(out, sum(scans * radar.setup.scan_bytes for radar in radars.values()))
    if not any(len(each.paths(0)) for each in ([source] if player.is_lidar(source) else radars.values())):
        typer.echo(f"{scene}: no echo of a wall or an object reaches the sensor", err=True)
    with progress_bar("messages", total or None) as advance:
        sent = player.with_walls(player.scene_events(source, scans), source, params)
        events = _counted_by(advance, (event.outgoing for event in sent))
        origin = {"scene": source.scene.name, "seed": str(seed)}
        if not player.is_lidar(source):
            origin |= source.described()
        if isinstance(source, ScenePlayer) and out.suffix != ".mcap":
            write_sigmf(out, source.setup, iter(events), origin)
        else:
            write_recording(out, iter(events), origin)
    print_line(f"{out}: {counted(scans, 'scan')} of {source.scene.name}, seed {seed}")


def _counted_by(advance: Callable[[], None], events: Iterator[Outgoing]) -> Iterator[Outgoing]:
    for event in events:
        yield event
        advance()


def write_recording(path: Path, events: Iterator[Outgoing], metadata: dict[str, str]) -> None:
    """MCAP recording of messages at the times their stamps say, as if `player` had sent them."""
    from msgs.recording.mcap import whole_recording

    with whole_recording(path, metadata) as writer:
        for topic, message in events:
            writer.write(topic, message, publisher="player", sent_ns=_sent_ns(message))


def _sent_ns(message: Any) -> int:
    """Return when a player sends a message: at its stamp; a LiDAR's scan at the time of its last azimuth."""
    from msgs.values.lidar import PhotonHistograms

    return int(message.azimuth_stamp_ns[-1] if isinstance(message, PhotonHistograms) else message.stamp_ns)


def write_sigmf(path: Path, setup: RadarSetup, events: Iterator[Outgoing], metadata: dict[str, str]) -> None:
    """SigMF capture of the beams; the truth goes beside it as a recording with `metadata`."""
    from msgs.recording.sigmf import write_capture
    from msgs.values.radar import RadarBeam
    from nodes.player import truth_beside

    truths: list[Outgoing] = []

    def beams() -> Iterator[RadarBeam]:
        for outgoing in events:
            if isinstance(outgoing.message, RadarBeam):
                yield outgoing.message
            elif outgoing.topic == "sim/truth":
                truths.append(outgoing)

    meta_path, data_path = write_capture(path, setup, beams())
    try:
        write_recording(truth_beside(path), iter(truths), metadata)
    except BaseException:
        meta_path.unlink()
        data_path.unlink()
        raise
