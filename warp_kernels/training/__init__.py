"""What else a training step does to Gaussians and images."""
