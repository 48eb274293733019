"""What thermosplat-train does around a training: on one device or several, watched or not."""
