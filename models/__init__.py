"""Floor 2, what is known: physics, vehicle, perception. Knows no bus, no clock, no socket."""

from msgs.files.former_modules import know_former_names

know_former_names()
