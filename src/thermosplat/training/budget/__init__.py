"""``--budget auto``: a model no larger than the scene needs."""
