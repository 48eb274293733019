"""Training: the loop (trainer.py) and what it is made of."""
