"""Arrays as pictures that people look at: PNGs, strips, videos."""
