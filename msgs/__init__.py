"""Floor 1, the shared data: values, topics, codec, bus, recording."""
