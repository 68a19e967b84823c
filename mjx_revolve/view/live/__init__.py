"""A running world to look at and to play with: the page and its server."""
