"""Lenses and the pose between the cameras, from pictures of a board."""
