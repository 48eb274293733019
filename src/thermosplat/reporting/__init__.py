"""What a client receives of a run: findings, measurements and a form, as HTML and as PDF."""
