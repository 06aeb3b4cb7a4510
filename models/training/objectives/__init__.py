"""What networks are trained towards: targets and losses."""
