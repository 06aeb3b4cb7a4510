"""The laboratory beside the road: training, evaluation, comparisons, full-wave tables; the floors know none of it."""

# what holds for every program, before a library of the laboratory is imported
import models  # noqa: F401
