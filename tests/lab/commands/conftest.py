"""Every figure that a test of this folder saves keeps its legends off its data."""

from tests.figures import recorded, saved_figures

__all__ = ["recorded", "saved_figures"]
