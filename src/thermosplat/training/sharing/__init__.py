"""One scene that several ranks train: Gaussians divided over them, decoders and cameras on each."""
