"""What thermosplat-export writes: splats, surfaces, maps."""
