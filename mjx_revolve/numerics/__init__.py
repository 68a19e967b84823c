"""Arithmetic without robots or water: spatial algebra, articulated bodies, what makes XLA fast."""
