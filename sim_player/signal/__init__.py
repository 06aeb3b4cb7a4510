"""From paths to samples and range profiles: array, waveform, receiver."""
