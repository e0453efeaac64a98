"""The three stages behind one `learn()` (Algorithm 1)."""
