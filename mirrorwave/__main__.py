"""`python -m mirrorwave`: the same as the command `mirrorwave`."""

from __future__ import annotations

import sys

from mirrorwave.cli import main

sys.exit(main())
