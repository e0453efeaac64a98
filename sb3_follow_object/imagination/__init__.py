"""F_phi, the curriculum over its goals, and the wrappers that show them (section 4.2, 4.3)."""
