"""Parts of bench_prepare.py."""
