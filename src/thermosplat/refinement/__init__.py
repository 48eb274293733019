"""Cameras that improve while training: poses, the rig, focal lengths, what distortion is left."""
