"""Files on input: arrays, YAML, whole files, and the folders of shipped files."""
