"""Changes that a person makes to a running graph: messages and parameters of their own."""
