"""Worlds traced by a foreign ray tracer: export of scenes as triangles, paths back in our terms."""
