"""What bench_rasterization.py is made of."""
