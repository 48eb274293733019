"""Image files: where they lie, how they are named, what is in them."""
