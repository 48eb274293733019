"""A run on disk: its folder, its lock, its checkpoints, and the device it uses."""
