"""Grids of tasks, methods and seeds: run, tested, drawn (section 5)."""
