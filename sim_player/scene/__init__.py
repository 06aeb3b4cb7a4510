"""A scene: its description, its objects and materials, and its frozen state at a time."""
