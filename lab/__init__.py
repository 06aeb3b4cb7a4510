"""The laboratory beside the road: training, evaluation, comparisons, full-wave tables; the floors know none of it."""
