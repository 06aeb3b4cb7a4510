"""Bridges to the live tools of others, and the messages that conversions share with them."""
