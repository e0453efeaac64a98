"""DDPG as the HER papers run it (section 3.2), its networks and updates, auxiliary critics, RND."""
