"""Views of a scene from cameras that no photograph was taken with."""
