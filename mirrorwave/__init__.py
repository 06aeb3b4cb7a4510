"""Floor 5, the command line. Its import makes the floors below importable, in a checkout as in an installation."""

from mirrorwave.floors import use_own_floors

use_own_floors()
