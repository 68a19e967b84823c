"""Episodes: configurations, starts, rollouts, tasks, scores, the fitness of a population."""
