"""What bench_training.py and its siblings are made of."""
