"""F_phi, the curriculum over its goals, and the wrappers that show them (sections 4.2 and 4.3)."""
