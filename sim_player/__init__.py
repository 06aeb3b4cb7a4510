"""Floor 3, the world that answers: scenes, paths, beams, truth. Pure: knows no bus."""
