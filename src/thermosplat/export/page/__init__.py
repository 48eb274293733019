"""A scene as one HTML page that shows and measures it: no server, no network."""
