"""Helpers that know nothing of learning: files, trees of arrays, YAML, seeds, copies, signals."""
