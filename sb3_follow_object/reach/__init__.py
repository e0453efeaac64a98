"""Reaching first: a policy that brings the effector to the object before the learner acts."""
