"""`mirrorwave`, and `python -m mirrorwave`: whoever ends it while it is still being loaded gets the same code."""

from __future__ import annotations

import sys

from mirrorwave.early_start import begin
from mirrorwave.exit_signals import ended_by_signal, hear_endings, keep_code, was_interrupted
from mirrorwave.terminal import open_closed_streams


def main() -> int:
    """Run the command line; returns its exit code."""
    open_closed_streams()
    try:
        hear_endings()
        begin(sys.argv[1:])
        from mirrorwave.cli import main as run

        code = run()
    except (KeyboardInterrupt, Exception):
        if not was_interrupted():
            raise
        code = ended_by_signal()
    keep_code()
    return code


if __name__ == "__main__":
    sys.exit(main())
