"""Coverage-guided fuzzing of everything that reads bytes from outside: decoders, file readers, parsers of words.

`python -m fuzz` runs all targets (docs/results/README.md); `tests/fuzz/test_decoders.py` replays the corpus
in CI.
"""
