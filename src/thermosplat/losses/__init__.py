"""What training minimises: terms on images and on Gaussians."""
