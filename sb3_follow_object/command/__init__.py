"""The command `sb3-follow-object`, and the pictures that it draws."""
