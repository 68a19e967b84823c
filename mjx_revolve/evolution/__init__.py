"""Evolution: strategies, the loop, run folders, and where a population is evaluated."""
