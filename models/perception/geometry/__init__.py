"""From classified peaks to walls, hidden points and objects of one scan."""
