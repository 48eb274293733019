"""How images come of blended Gaussians: a kind of formation in a file, and what all of them have in common."""
