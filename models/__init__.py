"""Floor 2, what is known: physics, perception, networks, training. Knows no bus, no clock, no socket."""
