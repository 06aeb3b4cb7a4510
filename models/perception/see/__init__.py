"""Step 4: evidence of all mirrors becomes hidden objects."""
