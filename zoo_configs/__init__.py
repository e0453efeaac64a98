"""Training settings as YAML, one file an algorithm."""

from pathlib import Path

FOLDER = Path(__file__).parent
