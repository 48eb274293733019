"""Differentiable Gaussian rasterization in NVIDIA Warp: projection, tile binning, blending and their adjoints.

Imports Warp and numpy only; knows nothing of torch or thermosplat. One source runs on CUDA and on Warp's CPU backend.
A kernel's ``dtype`` is ``wp.float32``, or ``wp.float64``, the reference of its accuracy.
"""
