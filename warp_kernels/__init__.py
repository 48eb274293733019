"""Differentiable Gaussian rasterization in NVIDIA Warp: projection, tile binning, blending and their adjoints.

Imports Warp and numpy only; knows nothing of torch or thermosplat. One source runs on CUDA and on Warp's CPU backend.
"""
