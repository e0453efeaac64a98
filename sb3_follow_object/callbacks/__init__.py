"""Rollouts without noise, tests at h_max (Algorithm 1), validation, and reaching that fades."""
