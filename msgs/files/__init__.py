"""Files at the door: arrays, YAML, whole files, and where shipped files are."""
