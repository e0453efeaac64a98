"""Training settings as YAML, one file an algorithm."""
