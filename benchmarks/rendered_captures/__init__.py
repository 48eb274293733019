"""The captures that this project rendered, to be made again: ``python -m rendered_captures desk --out DIR``."""
