"""Step 2: maps become peaks, direct and mirrored."""
