"""`mirrorwave view`: a recording in the viewer's page, with a timeline."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Annotated

import typer

from mirrorwave.console import print_line
from msgs.values.wording import counted


def view(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="MCAP recording of a graph.")],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page; 0 takes a free one.")] = 8765,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the address.")] = False,
) -> None:
    """Look at a recording in the browser: seek, step, play at any speed; Ctrl-C ends it."""
    import webbrowser

    from mirrorwave.replay.playback import Playback
    from msgs.recording.mcap import RecordingReader
    from nodes.viewer.newest import Board
    from nodes.viewer.server import ViewerServer

    with RecordingReader(recording) as reader:
        print_line(f"{recording}: reading")
        board = Board()
        playback = Playback(reader, board)
        with (
            ViewerServer(board, title=recording.name, port=port, commands=playback.commands.put) as server,
            contextlib.suppress(KeyboardInterrupt),
        ):
            print_line(f"{recording}: {counted(playback.count, 'scan')}; open {server.url} (Ctrl-C ends it)")
            if not no_browser:
                webbrowser.open(server.url)
            playback.run()
