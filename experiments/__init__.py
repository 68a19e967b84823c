"""Studies that recompute published numbers; run from the repository's root with `python -m`."""
