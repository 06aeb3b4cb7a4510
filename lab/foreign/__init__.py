"""A foreign ray tracer on places of ours."""
