"""The three stages behind one `learn()` (Algorithm 1), and the folder that they are saved in."""
