"""From two cameras' files to a capture that can be trained on: import, pair, calibrate, sfm, register, check."""
