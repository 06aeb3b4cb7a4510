"""CAN at the door: buses and logs."""
