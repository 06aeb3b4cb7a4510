"""CAN input and output: buses and logs."""
