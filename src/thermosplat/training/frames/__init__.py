"""Which training images a step sees."""
