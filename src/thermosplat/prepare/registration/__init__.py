"""The thermal camera beside the photographs' camera, from the scene itself: no board is needed."""
