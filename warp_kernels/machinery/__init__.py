"""What kernels of every subject are built with: lanes, sums, lists, launches, tapes."""
