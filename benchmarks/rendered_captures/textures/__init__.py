"""Images on surfaces, drawn by chance."""
