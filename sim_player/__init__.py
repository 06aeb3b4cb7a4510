"""Floor 3, the world that answers: scenes, paths, beams, truth. Pure: knows no bus."""

from msgs.files.former_modules import know_former_names

know_former_names()
