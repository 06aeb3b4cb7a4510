"""Floor 1, what is said: values, topics, codec, bus, recording."""
