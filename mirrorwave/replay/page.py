"""A recording served as the viewer's page until Ctrl-C."""

from __future__ import annotations

import contextlib
import webbrowser
from collections.abc import Callable
from pathlib import Path

from mirrorwave.replay.playback import Playback
from msgs.recording.mcap import RecordingReader
from msgs.values.wording import counted
from nodes.viewer.newest import Board
from nodes.viewer.series import SeriesStore
from nodes.viewer.server import ViewerServer


def serve_recording(
    recording: Path, port: int, opens_browser: bool, tell: Callable[[str], None], title: str | None = None
) -> None:
    """Serve the page of a recording on 127.0.0.1; return at Ctrl-C.

    `tell` gets the lines for the user, the last with the address. `title`: the file's name where None. Raises
    `ValueError` naming the file where it is no recording or holds no view, `OSError` where there is no port.
    """
    with RecordingReader(recording) as reader:
        tell(f"{recording}: reading")
        board = Board(SeriesStore(keeps_all=True))
        playback = Playback(reader, board)
        with (
            ViewerServer(board, title=title or recording.name, port=port, commands=playback.commands.put) as server,
            contextlib.suppress(KeyboardInterrupt),
        ):
            tell(f"{recording}: {counted(playback.count, 'scan')}; open {server.url} (Ctrl-C ends it)")
            if opens_browser:
                webbrowser.open(server.url)
            playback.run()
