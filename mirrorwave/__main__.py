"""`mirrorwave`, and `python -m mirrorwave`: whoever ends it while it is still being loaded gets a line as well."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line; returns its exit code."""
    try:
        from mirrorwave.cli import main as run
    except KeyboardInterrupt:
        sys.stderr.write("mirrorwave: interrupted\n")
        return 1
    return run()


if __name__ == "__main__":
    sys.exit(main())
