"""Building footprints of maps as scenes."""
