"""Labelled data sets in resumable shards."""
