"""The file formats of splats."""
