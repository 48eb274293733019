"""What is trained: Gaussians and decoders, and the images that they make of a view."""
