"""Help for tests that other people write of their own nodes."""
