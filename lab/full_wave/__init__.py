"""A two-dimensional full-wave solver (FDTD) and the wall experiments that it runs."""
