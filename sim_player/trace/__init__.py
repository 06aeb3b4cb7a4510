"""Ray tracing: paths of echoes, their segments and vertices, and the truth they give."""
