"""Step 5: objects of successive scans become tracks."""
