"""Hidden objects from a map and its walls: what every cell would be if a wall had mirrored it, and a network's say."""
