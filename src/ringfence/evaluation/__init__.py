"""How a policy does: in a simulator, in anybody's, and by logs alone."""
