"""Parts of the recorder: files, snapshots and their trigger."""
