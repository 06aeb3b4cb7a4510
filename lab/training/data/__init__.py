"""Training data: frames, samples, splits, published data sets."""
