"""What a training does beside its steps, from time to time: one file for each of them."""
