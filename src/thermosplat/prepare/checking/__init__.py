"""What is right and wrong with a capture, before anybody trains on it."""
