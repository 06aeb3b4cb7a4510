"""Recordings of topics (MCAP) and raw captures (SigMF)."""
