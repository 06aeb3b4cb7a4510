"""What a running graph does and why it does not."""
