"""Training's own kernels as torch functions: each does in one pass over memory what torch does in many."""
