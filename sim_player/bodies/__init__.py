"""Bodies of known shape, meshes and primitives: their scattering centres and the fields of these."""
