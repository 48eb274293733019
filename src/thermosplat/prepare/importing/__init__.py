"""From the files that cameras wrote to the images of a capture, with temperatures and a unit."""
