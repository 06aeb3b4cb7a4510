"""What all studies share: reports, and runs that go on where they stopped."""
