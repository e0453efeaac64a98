"""What can be set: every setting once, with its type, range and default, and the presets."""
