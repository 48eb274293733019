"""A training as a process: what it says, what it writes, how it ends and goes on."""
