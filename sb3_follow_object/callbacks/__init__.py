"""Rollouts without noise, the curriculum's tests at h_max (Algorithm 1), and validation."""
