"""Tensors of torch as arrays of Warp, and launches on torch's streams."""
