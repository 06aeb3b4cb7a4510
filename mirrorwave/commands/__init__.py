"""The verbs of the command line, thin: options in, one call, a table or JSON out."""
