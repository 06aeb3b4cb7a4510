"""Step 3: peaks become walls, and images are folded back in them."""
