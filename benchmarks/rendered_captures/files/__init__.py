"""From a scene to the files of a capture."""
