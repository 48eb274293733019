"""Which thermal image was taken with which photograph."""
