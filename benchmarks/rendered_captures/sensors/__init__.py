"""From radiance to the images of cameras."""
