"""Ways of echoes as the effects make them: routes, echoes, the table of paths."""
