"""The decoders' pixel-wise networks on tensor cores, and their adjoint. CUDA only."""
