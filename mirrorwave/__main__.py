"""`mirrorwave`, and `python -m mirrorwave`: whoever ends it while it is still being loaded gets a line as well."""

from __future__ import annotations

import sys

from mirrorwave.terminal import HUNG_UP, has_hung_up, hear_hangup, open_closed_streams


def main() -> int:
    """Run the command line; returns its exit code."""
    open_closed_streams()
    try:
        hear_hangup()
        from mirrorwave.cli import main as run
    except KeyboardInterrupt:
        if has_hung_up():
            return HUNG_UP
        sys.stderr.write("mirrorwave: interrupted\n")
        return 1
    return run()


if __name__ == "__main__":
    sys.exit(main())
