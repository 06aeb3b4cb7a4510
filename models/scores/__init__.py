"""How far answers are from the truth: points and objects."""
