"""The verbs of the laboratory: thin modules, named in `mirrorwave.cli`."""
