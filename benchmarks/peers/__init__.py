"""The renderers and training steps that ours are compared with."""
