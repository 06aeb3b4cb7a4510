"""What stands there: descriptions, walls, objects, the air, and what is in whose way."""
