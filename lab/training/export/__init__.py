"""From trained networks to the files that the vehicle loads."""
