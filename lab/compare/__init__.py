"""One scene through several sensors, beside closed forms."""
